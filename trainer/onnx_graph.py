"""The ONNX graphs of a policy and of a multiplier network, the observation normaliser inside.

Built node by node: the networks are small, so this needs neither an exporter nor its tracing, and says
exactly what is in the file.
"""

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from pointgoal.lidar import TINY
from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE
from trainer.actions import RAMP, ActionRange
from trainer.features import COASTING, DIRECTIONS, GAIN, SHARPNESS, Features, Surroundings
from trainer.networks import HIDDEN, Shape
from trainer.normaliser import CLIP

OPSET = 17
SENSED = "sensed"
"""The observation in double precision."""
IR_VERSION = 8
Floats = npt.NDArray[np.float32]


class _Builder:
    """Collects nodes and constants of a graph; a node takes the last one's output.

    Numbers are rounded to float32 as the networks' are, arithmetic is float64: the way out of the dead zone
    is so steep that rounding on the way to it would show in the action.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.last = "observation"
        self.node("Cast", output=SENSED, to=TensorProto.DOUBLE)

    def constant(self, value: npt.ArrayLike) -> str:
        return self._keep(np.asarray(value, np.float32).astype(np.float64))

    def integers(self, value: npt.ArrayLike) -> str:
        return self._keep(np.asarray(value, np.int64))

    def _keep(self, value: npt.NDArray[np.generic]) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(value, name))
        return name

    def node(
        self, operator: str, *others: str, output: str | None = None, **attributes: int | list[int]
    ) -> None:
        result = output or f"t{len(self.nodes)}"
        node = helper.make_node(operator, [self.last, *others], [result])
        node.attribute.extend(helper.make_attribute(name, value) for name, value in attributes.items())
        self.nodes.append(node)
        self.last = result

    def columns(self, where: slice) -> str:
        """Numbers of the observation [batch, k]."""
        self.last = SENSED
        self.node("Slice", *(self.integers([k]) for k in (where.start, where.stop, 1)))
        return self.last

    def rolled(self, bins: str, shift: int) -> str:
        """Of each bin, the number of the bin `shift` before it."""
        self.last = bins
        order = (np.arange(LIDAR_BINS) - shift) % LIDAR_BINS
        self.node("Gather", self.integers(order), axis=1)
        return self.last

    def chain(self, start: str, *steps: tuple[str, ...]) -> str:
        """Nodes one after the other, each an operator and its further inputs; the last one's output."""
        self.last = start
        for operator, *others in steps:
            self.node(operator, *others)
        return self.last

    def places(self, reading: str) -> tuple[str, str, str]:
        """pointgoal.lidar.places."""
        zero, half, one = self.constant(0.0), self.constant(0.5), self.constant(1.0)
        distance = self.chain(reading, ("Neg",), ("Add", one), ("Mul", self.constant(LIDAR_RANGE)))
        divisor = self.chain(reading, ("Max", self.constant(TINY)))
        upper = self.chain(self.rolled(reading, -1), ("Div", divisor), ("Min", one))
        lower = self.chain(self.rolled(reading, 1), ("Div", divisor), ("Neg",), ("Add", one), ("Max", zero))
        bins = self.constant(np.arange(LIDAR_BINS))
        bearing = self.chain(
            lower, ("Add", upper), ("Mul", half), ("Add", bins), ("Mul", self.constant(BIN_WIDTH))
        )
        x = self.chain(bearing, ("Cos",), ("Mul", distance))
        y = self.chain(bearing, ("Sin",), ("Mul", distance))
        return x, y, distance

    def goal(self, reading: str) -> tuple[str, str, str, str]:
        """features._goal."""
        found = self.places(reading)
        self.last = reading
        self.node("ArgMax", axis=1)
        top = self.last
        x, y, distance, seen = (self.taken(of, top) for of in (*found, self.chain(reading, ("Sign",))))
        inverse = self.chain(distance, ("Max", self.constant(TINY)), ("Reciprocal",), ("Mul", seen))
        return self.chain(x, ("Mul", inverse)), self.chain(y, ("Mul", inverse)), distance, seen

    def taken(self, bins: str, which: str) -> str:
        """Of each row, the number of one bin [batch, 1]."""
        self.last = bins
        self.node("GatherElements", which, axis=1)
        return self.last

    def sum_of_products(self, a: str, b: str, c: str, d: str) -> str:
        """The number a b + c d."""
        first = self.chain(a, ("Mul", b))
        return self.chain(c, ("Mul", d), ("Add", first))

    def turned(self, x: str, y: str, ux: str, uy: str) -> tuple[str, str]:
        """features._turned."""
        return self.sum_of_products(x, ux, y, uy), self.sum_of_products(y, ux, x, self.chain(uy, ("Neg",)))

    def from_segment(self, x: str, y: str, dx: str, dy: str) -> str:
        """features._from_segment."""
        square = self.chain(self.sum_of_products(dx, dx, dy, dy), ("Add", self.constant(TINY)))
        clip = "Clip", self.constant(0.0), self.constant(1.0)
        share = self.chain(self.sum_of_products(x, dx, y, dy), ("Div", square), clip)
        ex, ey = self.chain(share, ("Mul", dx), ("Sub", x)), self.chain(share, ("Mul", dy), ("Sub", y))
        return self.chain(self.sum_of_products(ex, ex, ey, ey), ("Sqrt",))

    def map(self, length: float, along: str, left: str, distance: str) -> str:
        """features.Surroundings._map."""
        last, sharpness = self.integers([2]), self.constant(SHARPNESS)
        ratio = self.chain(distance, ("Max", self.constant(TINY)), ("Reciprocal",), ("Mul", sharpness))
        ahead = self.chain(
            along, ("Mul", ratio), ("Unsqueeze", last), ("Mul", self.constant(np.cos(DIRECTIONS)))
        )
        cosine = self.chain(
            left,
            ("Mul", ratio), ("Unsqueeze", last), ("Mul", self.constant(np.sin(DIRECTIONS))), ("Add", ahead),
        )  # fmt: skip
        level = self.chain(distance, ("Mul", self.constant(-0.5 / length)), ("Sub", sharpness))
        self.chain(level, ("Unsqueeze", last), ("Add", cosine))
        self.node("ReduceMax", axes=[1], keepdims=0)
        return self.chain(self.last, ("Exp",), ("Mul", self.constant(GAIN)))

    def surroundings(self, surroundings: Surroundings) -> list[str]:
        """features.Surroundings, operation by operation: its parts, to stand beside each other."""
        gain = self.constant(GAIN)
        hazards = self.columns(surroundings.hazards)
        x, y, distance = self.places(hazards)
        ux, uy, away, seen = self.goal(self.columns(surroundings.goal))
        start = surroundings.velocity.start
        time = self.constant(COASTING)
        cx, cy = (self.chain(self.columns(slice(k, k + 1)), ("Mul", time)) for k in (start, start + 1))
        gx, gy = self.chain(ux, ("Mul", away)), self.chain(uy, ("Mul", away))
        rate = self.constant(-1 / surroundings.length)
        near, passing, to_goal = (
            self.chain(of, ("Mul", rate), ("Exp",), ("Mul", gain))
            for of in (distance, self.from_segment(x, y, cx, cy), self.from_segment(x, y, gx, gy))
        )
        to_goal = self.chain(hazards, ("Sign",), ("Mul", to_goal))
        shown = self.map(surroundings.length, *self.turned(x, y, ux, uy), distance)
        two = self.constant(2.0)
        toward = [self.chain(of, ("Mul", two)) for of in (ux, uy)]
        close = self.chain(away, ("Neg",), ("Exp",), ("Mul", seen), ("Mul", gain))
        coasting = [self.chain(part, ("Mul", gain)) for part in self.turned(cx, cy, ux, uy)]
        return [near, passing, to_goal, shown, *toward, close, *coasting]

    def features(self, features: Features) -> None:
        """The networks' inputs, see features.Features."""
        mean, inverse = features.normaliser.scale()
        others = [] if features.surroundings is None else self.surroundings(features.surroundings)
        self.last = SENSED
        self.node("Sub", self.constant(mean))
        self.node("Mul", self.constant(inverse))
        self.node("Clip", self.constant(-CLIP), self.constant(CLIP))
        if others:
            self.node("Concat", *others, axis=1)

    def network(self, theta: Floats, shape: Shape, features: Features) -> None:
        """Runs a network on the observation's features."""
        self.features(features)
        w1, b1, w2, b2, w3, b3 = np.split(theta, np.cumsum(shape.splits)[:-1])
        layers = (w1.reshape(-1, HIDDEN), b1), (w2.reshape(HIDDEN, HIDDEN), b2), (w3.reshape(HIDDEN, -1), b3)
        for k, (weight, bias) in enumerate(layers):
            self.node("Gemm", self.constant(weight), self.constant(bias))
            if k < 2:
                self.node("Tanh")

    def model(self, inputs: int, output: str, output_shape: list[str | int]) -> bytes:
        self.node("Cast", output=output, to=TensorProto.FLOAT)
        graph = helper.make_graph(
            self.nodes,
            "lagnet",
            [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", inputs])],
            [helper.make_tensor_value_info(output, TensorProto.FLOAT, output_shape)],
            self.constants,
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="lagnet",
        )
        onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString())


def policy_graph(theta: Floats, shape: Shape, features: Features, actions: ActionRange) -> bytes:
    """Observation [batch, n] → action [batch, a]: the policy's mean, as it is sent to the robot.

    Args:
        theta: the actor network's parameters [P].
        shape: its layer sizes.
        features: what it sees.
        actions: unit and bounds of the actions.

    Returns:
        The file's bytes.
    """
    builder = _Builder()
    builder.network(theta, shape, features)
    drawn = builder.last
    clip = "Clip", builder.constant(-1.0), builder.constant(1.0)
    dead = builder.constant(actions.dead)
    jump = builder.chain(drawn, ("Mul", builder.constant(1 / RAMP)), clip, ("Mul", dead))
    builder.chain(drawn, ("Mul", builder.constant(actions.unit)), ("Add", jump))
    builder.node("Max", builder.constant(actions.low))
    builder.node("Min", builder.constant(actions.high))
    return builder.model(len(features.normaliser.mean), "action", ["batch", shape.outputs])


def multiplier_graph(theta: Floats, shape: Shape, features: Features, scale: float, power: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: scale · softplus(f_ξ(s))^power.

    Args:
        theta: the multiplier network's parameters [P].
        shape: its layer sizes.
        features: what it sees.
        scale: what the power is multiplied by.
        power: what the softplus is raised to.

    Returns:
        The file's bytes.
    """
    builder = _Builder()
    builder.network(theta, shape, features)
    # onnxruntime has no Softplus for float64: max(x, 0) + log(1 + exp(−|x|)).
    x, one = builder.last, builder.constant(1.0)
    rest = builder.chain(x, ("Abs",), ("Neg",), ("Exp",), ("Add", one), ("Log",))
    builder.chain(x, ("Max", builder.constant(0.0)), ("Add", rest))
    builder.node("Pow", builder.constant(power))
    builder.node("Mul", builder.constant(scale))
    builder.node("Squeeze", builder.integers([1]))
    return builder.model(len(features.normaliser.mean), "multiplier", ["batch"])


def constant_graph(inputs: int, value: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: the same value in every state."""
    builder = _Builder()
    builder.node("ReduceSum", builder.integers([1]), keepdims=0)
    builder.node("Mul", builder.constant(0.0))
    builder.node("Add", builder.constant(value))
    return builder.model(inputs, "multiplier", ["batch"])
