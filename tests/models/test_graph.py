"""What is read of ONNX files, and bytes that are none."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import onnx
from hypothesis import given
from hypothesis import strategies as st

from models.errors import BundleError
from models.graph import Tensor, check_graph, read_graph


def test_it_reads_what_a_graph_declares(tiny_bundle: Path) -> None:
    for name in ("policy.onnx", "multiplier.onnx"):
        data = (tiny_bundle / name).read_bytes()
        graph, model = read_graph(data), onnx.load_from_string(data)
        assert graph.opsets == {entry.domain: entry.version for entry in model.opset_import}
        for ours, theirs in ((graph.inputs, model.graph.input), (graph.outputs, model.graph.output)):
            assert list(ours) == [
                Tensor(
                    value.name,
                    value.type.tensor_type.elem_type,
                    tuple(
                        dim.dim_value if dim.HasField("dim_value") else None
                        for dim in value.type.tensor_type.shape.dim
                    ),
                )
                for value in theirs
            ]
        assert not graph.external


def test_initialised_inputs_need_no_feed(tiny_bundle: Path) -> None:
    model = onnx.load(tiny_bundle / "policy.onnx")
    weights = model.graph.initializer[0]
    model.graph.input.append(
        onnx.helper.make_tensor_value_info(weights.name, weights.data_type, weights.dims)
    )
    assert [tensor.name for tensor in read_graph(model.SerializeToString()).inputs] == ["observation"]


@given(st.binary(max_size=300))
def test_arbitrary_bytes_end_in_its_own_error_or_a_graph(data: bytes) -> None:
    with suppress(BundleError):
        if not read_graph(data).external:
            check_graph(data)


@given(st.data())
def test_a_cut_or_damaged_file_ends_in_its_own_error_or_a_graph(
    tiny_bundle: Path, data: st.DataObject
) -> None:
    whole = bytearray((tiny_bundle / "policy.onnx").read_bytes())
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(whole)))
    with suppress(BundleError):
        if not read_graph(bytes(whole[:end])).external:
            check_graph(bytes(whole[:end]))
