"""The ONNX graphs of a policy and of a multiplier network, the observation normaliser inside.

Built node by node: the networks are small, so this needs neither an exporter nor its tracing, and says
exactly what is in the file.
"""

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE
from trainer.actions import ActionRange
from trainer.features import COASTING, GAIN, TINY, Features, Nearness
from trainer.networks import HIDDEN, Shape
from trainer.normaliser import CLIP

OPSET = 17
IR_VERSION = 8
Floats = npt.NDArray[np.float32]


class _Builder:
    """Collects nodes and constants of a graph; a node takes the last one's output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.last = "observation"

    def constant(self, value: npt.ArrayLike, kind: type = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def node(self, operator: str, *others: str, output: str | None = None, **attributes: int) -> None:
        result = output or f"t{len(self.nodes)}"
        node = helper.make_node(operator, [self.last, *others], [result])
        node.attribute.extend(helper.make_attribute(name, value) for name, value in attributes.items())
        self.nodes.append(node)
        self.last = result

    def columns(self, where: slice) -> str:
        """Numbers of the observation [batch, k]."""
        self.last = "observation"
        self.node("Slice", *(self.constant([k], np.int64) for k in (where.start, where.stop, 1)))
        return self.last

    def rolled(self, bins: str, shift: int) -> str:
        """Of each bin, the number of the bin `shift` before it."""
        self.last = bins
        order = (np.arange(LIDAR_BINS) - shift) % LIDAR_BINS
        self.node("Gather", self.constant(order, np.int64), axis=1)
        return self.last

    def chain(self, start: str, *steps: tuple[str, ...]) -> str:
        """Nodes one after the other, each an operator and its further inputs; the last one's output."""
        self.last = start
        for operator, *others in steps:
            self.node(operator, *others)
        return self.last

    def nearness(self, near: Nearness) -> str:
        """features.Nearness, operation by operation [batch, 2 · bins]."""
        zero, half, one = self.constant(0.0), self.constant(0.5), self.constant(1.0)
        reading = self.columns(near.readings)
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
        start = near.velocity.start
        time = self.constant(COASTING)
        dx, dy = (self.chain(self.columns(slice(k, k + 1)), ("Mul", time)) for k in (start, start + 1))
        square = self.chain(dy, ("Mul", dy))
        square = self.chain(dx, ("Mul", dx), ("Add", square), ("Add", self.constant(TINY)))
        along = self.chain(y, ("Mul", dy))
        share = self.chain(x, ("Mul", dx), ("Add", along), ("Div", square), ("Max", zero), ("Min", one))
        ex = self.chain(share, ("Mul", dx), ("Sub", x))
        ey = self.chain(share, ("Mul", dy), ("Sub", y))
        aside = self.chain(ey, ("Mul", ey))
        passing = self.chain(ex, ("Mul", ex), ("Add", aside), ("Sqrt",))
        self.last = distance
        self.node("Concat", passing, axis=1)
        rate, gain = self.constant(-1 / near.length), self.constant(GAIN)
        return self.chain(self.last, ("Mul", rate), ("Exp",), ("Mul", gain))

    def features(self, features: Features) -> None:
        """The networks' inputs, see features.Features."""
        mean, inverse = features.normaliser.scale()
        others = [] if features.nearness is None else [self.nearness(features.nearness)]
        self.last = "observation"
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
    builder.node("Mul", builder.constant(actions.unit))
    builder.node("Max", builder.constant(actions.low))
    builder.node("Min", builder.constant(actions.high), output="action")
    return builder.model(len(features.normaliser.mean), "action", ["batch", shape.outputs])


def multiplier_graph(theta: Floats, shape: Shape, features: Features, scale: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: scale · softplus(f_ξ(s)).

    Args:
        theta: the multiplier network's parameters [P].
        shape: its layer sizes.
        features: what it sees.
        scale: what the softplus is multiplied by.

    Returns:
        The file's bytes.
    """
    builder = _Builder()
    builder.network(theta, shape, features)
    builder.node("Softplus")
    builder.node("Mul", builder.constant(scale))
    builder.node("Squeeze", builder.constant([1], np.int64), output="multiplier")
    return builder.model(len(features.normaliser.mean), "multiplier", ["batch"])


def constant_graph(inputs: int, value: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: the same value in every state."""
    builder = _Builder()
    builder.node("ReduceSum", builder.constant([1], np.int64), keepdims=0)
    builder.node("Mul", builder.constant(0.0))
    builder.node("Add", builder.constant(value), output="multiplier")
    return builder.model(inputs, "multiplier", ["batch"])
