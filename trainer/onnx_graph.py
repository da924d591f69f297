"""The ONNX graphs of a policy and of a multiplier network, the observation normaliser inside.

Built node by node: the networks are small, so this needs neither an exporter nor its tracing, and says
exactly what is in the file.
"""

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from trainer.actions import ActionRange
from trainer.features import GAIN, Features
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

    def node(self, operator: str, *others: str, output: str | None = None) -> None:
        result = output or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [self.last, *others], [result]))
        self.last = result

    def features(self, features: Features) -> None:
        """The networks' inputs, see features.Features."""
        mean, inverse = features.normaliser.scale()
        near = features.nearness
        others: list[str] = []
        if near is not None:
            self.node("Slice", *(self.constant([k], np.int64) for k in (near.start, near.stop, 1)))
            self.node("Sub", self.constant(1.0))
            self.node("Mul", self.constant(near.rate))
            self.node("Exp")
            self.node("Mul", self.constant(GAIN))
            others = [self.last]
            self.last = "observation"
        self.node("Sub", self.constant(mean))
        self.node("Mul", self.constant(inverse))
        self.node("Clip", self.constant(-CLIP), self.constant(CLIP))
        if others:
            self.node("Concat", *others)
            self.nodes[-1].attribute.append(helper.make_attribute("axis", 1))

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
    builder.node("ReduceSum", builder.constant([1], np.int64))
    builder.nodes[-1].attribute.append(helper.make_attribute("keepdims", 0))
    builder.node("Mul", builder.constant(0.0))
    builder.node("Add", builder.constant(value), output="multiplier")
    return builder.model(inputs, "multiplier", ["batch"])
