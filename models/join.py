"""Both networks of a bundle as one graph, which computes once what they share.

Policy and multiplier network see the same features, which take most of their time. onnxruntime merges equal
nodes only where they read the same constant by name, so constants are told apart by their content here.
"""

from __future__ import annotations

from collections.abc import Iterable

import onnx
from onnx import numpy_helper

from models import features
from models.errors import BundleError
from models.features import FeatureNumbers

Key = tuple[object, ...]


def join(graphs: Iterable[bytes]) -> bytes:
    """One ONNX graph with the inputs that the graphs have in common and the outputs of all.

    Args:
        graphs: checked ONNX files with the same inputs and opset, and outputs of different names.

    Returns:
        The bytes of a graph that gives each output bit for bit as its own graph does. If all say the same of
        their features, so does it.

    Raises:
        BundleError: if a graph has graphs or functions of its own, as an export of a feed-forward network
            has not: their names are not taken apart here.
    """
    models = [onnx.load_model_from_string(data) for data in graphs]
    joined = onnx.ModelProto(ir_version=max(model.ir_version for model in models), producer_name="lagnet")
    joined.opset_import.extend(models[0].opset_import)
    joined.graph.name = "joined"
    constants: dict[Key, str] = {}
    nodes: dict[Key, list[str]] = {}
    told: set[FeatureNumbers | None] = set()
    for k, model in enumerate(models):
        _refuse_nested(model)
        graph = model.graph
        names = {name: name for name in ("", *(value.name for value in (*graph.input, *graph.output)))}
        for tensor in graph.initializer:
            names[tensor.name] = _constant(joined.graph, tensor, f"{k}.{tensor.name}", constants)
        for node in graph.node:
            _node(joined.graph, node, names, f"{k}.", nodes)
        joined.graph.output.extend(graph.output)
        told.add(_told(model, names))
    initialised = {tensor.name for tensor in models[0].graph.initializer}
    joined.graph.input.extend(value for value in models[0].graph.input if value.name not in initialised)
    same = told.pop()
    if same is not None and not told:
        features.write(joined, same)
    return bytes(joined.SerializeToString())


def _told(model: onnx.ModelProto, names: dict[str, str]) -> FeatureNumbers | None:
    """What a graph says of its features, by the name that they have in the joined one, if that is sense."""
    try:
        told = features.read(model)
    except BundleError:
        return None
    return told and told.model_copy(update={"tensor": names.get(told.tensor, "")})


def _refuse_nested(model: onnx.ModelProto) -> None:
    nested = any(attribute.g.node or attribute.graphs for n in model.graph.node for attribute in n.attribute)
    if nested or model.functions or model.graph.sparse_initializer:
        raise BundleError("a graph with subgraphs, functions or sparse tensors cannot be joined with another")


def _constant(graph: onnx.GraphProto, tensor: onnx.TensorProto, name: str, known: dict[Key, str]) -> str:
    """The joined graph's name of a constant, added unless it is there."""
    value = numpy_helper.to_array(tensor)
    key = value.dtype.str, value.shape, value.tobytes()
    if key not in known:
        known[key] = name
        added = graph.initializer.add()
        added.CopyFrom(tensor)
        added.name = name
    return known[key]


def _node(
    graph: onnx.GraphProto,
    node: onnx.NodeProto,
    names: dict[str, str],
    prefix: str,
    known: dict[Key, list[str]],
) -> None:
    """Adds a node unless one that computes the same is there; `names` learns what its outputs are called."""
    inputs = [names[name] for name in node.input]
    attributes = sorted(attribute.SerializeToString(deterministic=True) for attribute in node.attribute)
    key = node.domain, node.op_type, tuple(inputs), tuple(attributes), len(node.output)
    if key in known and not any(name in names for name in node.output if name):
        names.update(zip(node.output, known[key], strict=True))
        return
    outputs = [names.setdefault(name, prefix + name) for name in node.output]
    known.setdefault(key, outputs)
    added = graph.node.add()
    added.CopyFrom(node)
    added.name = ""
    added.input[:], added.output[:] = inputs, outputs
