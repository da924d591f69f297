"""What an ONNX file declares, read straight from its protobuf bytes.

The runtime installs onnxruntime but not onnx, and onnxruntime tells neither the opset nor whether a tensor
lives in another file (it would open that file, relative to the working directory). Both must be known before
a session sees the bytes, so this reads the few fields that matter. Field numbers: onnx.proto of ONNX 1.17.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from models.errors import BundleError

FLOAT = 1
"""TensorProto.DataType of float32."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10
_DEEPEST = 32
"""Nesting of graphs inside graphs that is still read; an exported MLP has one."""

# Every way from a message down to a tensor: {message: {field: message}}.
_DESCENT = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "function": {7: "node", 11: "attribute"},
    "training": {1: "graph", 2: "graph"},
}


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
    model = memoryview(data)
    opsets: dict[str, int] = {}
    graph: memoryview | None = None
    for field, value in _fields(model):
        if field == 8 and isinstance(value, memoryview):
            entry = dict(_fields(value))
            domain = _text(entry.get(1))
            opsets["" if domain == "ai.onnx" else domain] = _integer(entry.get(2))
        elif field == 7 and isinstance(value, memoryview):
            graph = value
    if graph is None or not opsets:
        raise BundleError("not an ONNX model: it has no graph or no opset")
    parts = [(field, value) for field, value in _fields(graph) if isinstance(value, memoryview)]
    initialised = {_text(dict(_fields(value)).get(8)) for field, value in parts if field == 5}
    inputs = tuple(_tensor(value) for field, value in parts if field == 11)
    return Graph(
        opsets=opsets,
        inputs=tuple(tensor for tensor in inputs if tensor.name not in initialised),
        outputs=tuple(_tensor(value) for field, value in parts if field == 12),
        external=_has_external(model, "model", 0),
    )


def _has_external(message: memoryview, kind: str, depth: int) -> bool:
    """Whether a tensor anywhere under a message sets external_data (13) or data_location (14) = EXTERNAL."""
    if depth > _DEEPEST:
        raise BundleError(
            f"not an ONNX model that an exporter writes: nested deeper than {_DEEPEST} messages"
        )
    for field, value in _fields(message):
        if kind == "tensor":
            if field == 13 or (field == 14 and value != 0):
                return True
            continue
        below = _DESCENT[kind].get(field)
        if below is not None and isinstance(value, memoryview) and _has_external(value, below, depth + 1):
            return True
    return False


def _tensor(value_info: memoryview) -> Tensor:
    """A ValueInfoProto: name 1, type 2 → tensor_type 1 → elem_type 1, shape 2 → dim 1 → dim_value 1."""
    info = dict(_fields(value_info))
    tensor = dict(_fields(_message(dict(_fields(_message(info.get(2)))).get(1))))
    sizes: list[int | None] = []
    for field, value in _fields(_message(tensor.get(2))):
        if field == 1:
            size = dict(_fields(_message(value))).get(1)
            sizes.append(size if isinstance(size, int) else None)
    return Tensor(name=_text(info.get(1)), dtype=_integer(tensor.get(1)), shape=tuple(sizes))


def _message(value: int | memoryview | None) -> memoryview:
    return value if isinstance(value, memoryview) else memoryview(b"")


def _text(value: int | memoryview | None) -> str:
    return bytes(_message(value)).decode("utf-8", "replace")


def _integer(value: int | memoryview | None) -> int:
    return value if isinstance(value, int) else 0


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of a protobuf message: (number, integer or bytes), in the file's order.

    Raises:
        BundleError: if the bytes are not protobuf.
    """
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        field, wire = key >> 3, key & 7
        if wire == _VARINT:
            number, at = _varint(message, at)
            yield field, number
            continue
        if wire == _BYTES:
            size, at = _varint(message, at)
        elif wire in (_FIXED64, _FIXED32):
            size = 8 if wire == _FIXED64 else 4
        else:
            raise BundleError("not an ONNX model: its bytes are not protobuf")
        if at + size > len(message):
            raise BundleError("not an ONNX model, or cut short")
        yield field, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A base-128 integer and where it ends."""
    number = 0
    for shift in range(_LONGEST_VARINT):
        if at >= len(message):
            raise BundleError("not an ONNX model, or cut short")
        byte = message[at]
        at += 1
        number |= (byte & 0x7F) << (7 * shift)
        if byte < 0x80:
            return number, at
    raise BundleError("not an ONNX model: its bytes are not protobuf")
