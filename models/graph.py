"""What an ONNX file declares, and whether it is one.

Both must be known before onnxruntime sees the bytes: it tells no opset, and a tensor that says it lives in
another file it would open there, relative to the working directory.
"""

from __future__ import annotations

from dataclasses import dataclass

import onnx
from google.protobuf.message import DecodeError, Message

from models.errors import BundleError

FLOAT = int(onnx.TensorProto.FLOAT)
"""TensorProto.DataType of float32."""


@dataclass(frozen=True)
class Tensor:
    """A declared input or output.

    Attributes:
        name: its name.
        dtype: TensorProto.DataType; `FLOAT` is float32.
        shape: its sizes; a symbolic or unknown one is None.
    """

    name: str
    dtype: int
    shape: tuple[int | None, ...]

    def __str__(self) -> str:
        sizes = ", ".join("batch" if size is None else str(size) for size in self.shape)
        return f"{self.name!r} {'float32' if self.dtype == FLOAT else f'data type {self.dtype}'} [{sizes}]"


@dataclass(frozen=True)
class Graph:
    """What an ONNX file declares.

    Attributes:
        opsets: operator domain → version; the standard domain is "".
        inputs: what a caller has to feed.
        outputs: what it gives.
        external: whether any tensor keeps its data outside the file.
    """

    opsets: dict[str, int]
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    external: bool


def read_graph(data: bytes) -> Graph:
    """Reads what an ONNX file declares.

    Args:
        data: the file's bytes.

    Raises:
        BundleError: if the bytes are no ONNX model.
    """
    try:
        model = onnx.load_model_from_string(data)
        graph = model.graph
        opsets = {"" if o.domain == "ai.onnx" else o.domain: o.version for o in model.opset_import}
        initialised = {tensor.name for tensor in graph.initializer}
        inputs = tuple(_tensor(value) for value in graph.input if value.name not in initialised)
        outputs = tuple(_tensor(value) for value in graph.output)
    except DecodeError as error:
        raise BundleError("not an ONNX model, or cut short") from error
    except UnicodeDecodeError as error:
        raise BundleError("not an ONNX model: a name in it is no text") from error
    if not model.HasField("graph") or not opsets:
        raise BundleError("not an ONNX model: it has no graph or no opset")
    return Graph(opsets, inputs, outputs, external=_has_external(model))


def check_graph(data: bytes) -> None:
    """Has onnx check a model: every operator known, every tensor whole, every input there when it is used.

    Args:
        data: the file's bytes, without external data, for which this would look at the disk.

    Raises:
        BundleError: if the model is not valid.
    """
    try:
        onnx.checker.check_model(data)
    except (onnx.checker.ValidationError, ValueError, RuntimeError) as error:
        raise BundleError(f"not a valid ONNX model: {error}") from error


def _has_external(message: Message) -> bool:
    """Whether a tensor anywhere in a message, in subgraphs and functions too, lies in another file."""
    if isinstance(message, onnx.TensorProto):
        return message.data_location != onnx.TensorProto.DEFAULT or len(message.external_data) > 0
    for field, value in message.ListFields():
        if field.message_type is not None:
            parts = (value,) if isinstance(value, Message) else value
            if any(_has_external(part) for part in parts):
                return True
    return False


def _tensor(value: onnx.ValueInfoProto) -> Tensor:
    declared = value.type.tensor_type
    sizes = tuple(dim.dim_value if dim.HasField("dim_value") else None for dim in declared.shape.dim)
    return Tensor(value.name, declared.elem_type, sizes)
