"""The ONNX graphs of a policy and of a multiplier network, the observation normaliser inside.

Built node by node: the networks are small, so this needs neither an exporter nor its tracing, and says
exactly what is in the file.
"""

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from trainer.networks import HIDDEN, Shape
from trainer.normaliser import CLIP

OPSET = 17
IR_VERSION = 8
Floats = npt.NDArray[np.float32]


class _Builder:
    """Collects nodes and constants of a graph that is a chain of tensors."""

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

    def network(self, theta: Floats, shape: Shape, mean: Floats, inverse: Floats) -> None:
        """Normalises the observation and runs a network on it."""
        self.node("Sub", self.constant(mean))
        self.node("Mul", self.constant(inverse))
        self.node("Clip", self.constant(-CLIP), self.constant(CLIP))
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


def policy_graph(
    theta: Floats, shape: Shape, mean: Floats, inverse: Floats, low: Floats, high: Floats
) -> bytes:
    """Observation [batch, n] → action [batch, a]: the mean action, clipped to the bounds.

    Args:
        theta: the actor network's parameters [P].
        shape: its layer sizes.
        mean: of the observations [n].
        inverse: 1 / their standard deviation [n].
        low: lower bounds of the action [a].
        high: upper bounds of the action [a].

    Returns:
        The file's bytes.
    """
    builder = _Builder()
    builder.network(theta, shape, mean, inverse)
    builder.node("Max", builder.constant(low))
    builder.node("Min", builder.constant(high), output="action")
    return builder.model(shape.inputs, "action", ["batch", shape.outputs])


def multiplier_graph(theta: Floats, shape: Shape, mean: Floats, inverse: Floats, scale: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: scale · softplus(f_ξ(s)).

    Args:
        theta: the multiplier network's parameters [P].
        shape: its layer sizes.
        mean: of the observations [n].
        inverse: 1 / their standard deviation [n].
        scale: what the softplus is multiplied by.

    Returns:
        The file's bytes.
    """
    builder = _Builder()
    builder.network(theta, shape, mean, inverse)
    builder.node("Softplus")
    builder.node("Mul", builder.constant(scale))
    builder.node("Squeeze", builder.constant([1], np.int64), output="multiplier")
    return builder.model(shape.inputs, "multiplier", ["batch"])


def constant_graph(inputs: int, value: float) -> bytes:
    """Observation [batch, n] → multiplier [batch]: the same value in every state."""
    builder = _Builder()
    builder.node("ReduceSum", builder.constant([1], np.int64))
    builder.nodes[-1].attribute.append(helper.make_attribute("keepdims", 0))
    builder.node("Mul", builder.constant(0.0))
    builder.node("Add", builder.constant(value), output="multiplier")
    return builder.model(inputs, "multiplier", ["batch"])
