"""A bundle is written whole or not at all, and loads only if every byte and every shape is what it says."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper

from models import Bundle, BundleError, Manifest, write_bundle

Edit = Callable[[dict[str, Any]], Any]


def edit_manifest(folder: Path, edit: Edit) -> None:
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def replace_graph(folder: Path, name: str, data: bytes) -> None:
    """Puts another graph in place and makes its digest right."""
    (folder / name).write_bytes(data)
    edit_manifest(folder, lambda m: m["sha256"].update({name: hashlib.sha256(data).hexdigest()}))


def edit_graph(folder: Path, name: str, edit: Callable[[onnx.ModelProto], Any]) -> None:
    model = onnx.load(folder / name)
    edit(model)
    replace_graph(folder, name, model.SerializeToString())


def refusal(folder: Path) -> str:
    with pytest.raises(BundleError) as caught:
        Bundle.load(folder)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_what_was_written_is_loaded(own_bundle: Path) -> None:
    bundle = Bundle.load(own_bundle)
    assert bundle.policy == bundle.policy_path.read_bytes()
    assert bundle.multiplier == bundle.multiplier_path.read_bytes()
    assert bundle.manifest.sha256["policy.onnx"] == hashlib.sha256(bundle.policy).hexdigest()
    assert Manifest.model_validate_json((own_bundle / "manifest.json").read_text()) == bundle.manifest


def test_a_setting_of_the_training_that_is_none_is_written_and_a_field_that_is_not_there_is_not(
    own_bundle: Path,
) -> None:
    bundle = Bundle.load(own_bundle)
    training = {"range": None, "more": {"seed": None, "list": [None]}}
    manifest = bundle.manifest.model_copy(update={"training": training})
    assert write_bundle(own_bundle, bundle.policy, bundle.multiplier, manifest).manifest.training == training
    assert "calibration" not in json.loads((own_bundle / "manifest.json").read_text())


def test_the_id_changes_with_anything_in_the_bundle(own_bundle: Path) -> None:
    before = Bundle.load(own_bundle).id
    edit_manifest(own_bundle, lambda m: m.update(threshold=0.25))
    assert Bundle.load(own_bundle).id != before


def test_the_robots_constants_are_kept_as_they_are_written(own_bundle: Path) -> None:
    assert Bundle.load(own_bundle).manifest.robot == {}
    edit_manifest(own_bundle, lambda m: m.pop("robot"))
    assert Bundle.load(own_bundle).manifest.robot == {}  # bundles from before it
    constants = {"mass": 0.0051887900000000001, "substeps": 10}
    edit_manifest(own_bundle, lambda m: m.update(robot=constants))
    loaded = Bundle.load(own_bundle).manifest
    assert loaded.robot == constants
    assert isinstance(loaded.robot["substeps"], int)
    assert Manifest.model_validate_json(loaded.to_json(), strict=True) == loaded


@pytest.mark.parametrize("name", ["manifest.json", "policy.onnx", "multiplier.onnx"])
def test_a_missing_file_is_named(own_bundle: Path, name: str) -> None:
    (own_bundle / name).unlink()
    assert name in refusal(own_bundle)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    assert "nowhere" in refusal(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["policy.onnx", "multiplier.onnx"])
def test_one_flipped_bit_is_noticed(own_bundle: Path, name: str) -> None:
    data = bytearray((own_bundle / name).read_bytes())
    data[len(data) // 2] ^= 1
    (own_bundle / name).write_bytes(data)
    message = refusal(own_bundle)
    assert name in message
    assert "sha256" in message


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (lambda m: m.update(format_version=2), "format_version is 2"),
        (lambda m: m.pop("format_version"), "format_version is None"),
        (lambda m: m.pop("threshold"), "threshold"),
        (lambda m: m.update(threshold=-0.1), "threshold"),
        (lambda m: m.update(threshold=math.nan), "threshold"),
        (lambda m: m.update(threshold=math.inf), "threshold"),
        (lambda m: m.update(threshold=True), "threshold"),
        (lambda m: m.update(threshold="0.5"), "threshold"),
        (lambda m: m.update(surprise=1), "surprise"),
        (lambda m: m.update(name="../../etc"), "name"),
        (lambda m: m.update(created="2026-01-01T00:00:00"), "created"),
        (lambda m: m.update(action_low=[1.0, 1.0]), "action_low"),
        (lambda m: m.update(observation_size=59), "observation_layout has 60 numbers"),
        (lambda m: m["observation_layout"].pop(2), "block 'magnetometer'"),
        (lambda m: m["observation_layout"][1].update(name="accelerometer"), "block 'accelerometer'"),
        (lambda m: m.update(training={"lr": math.nan}), "training"),
        (lambda m: m.update(robot={"mass": 0.0}), "robot.mass"),
        (lambda m: m.update(robot={"mass": -0.005}), "robot.mass"),
        (lambda m: m.update(robot={"mass": math.nan}), "robot.mass"),
        (lambda m: m.update(robot={"mass": math.inf}), "robot.mass"),
        (lambda m: m.update(robot={"mass": "0.005"}), "robot.mass"),
        (lambda m: m.update(robot={"mass": True}), "robot.mass"),
        (lambda m: m.update(robot=None), "robot"),
        (lambda m: m.update(robot=[0.005]), "robot"),
        (lambda m: m["sha256"].pop("multiplier.onnx"), "sha256 of multiplier.onnx is missing"),
        (lambda m: m["sha256"].update({"policy.onnx": "abc"}), "sha256.policy.onnx"),
        (lambda m: m.update(opset=18), "opset ai.onnx 17, the manifest says ai.onnx 18"),
    ],
)
def test_a_wrong_manifest_is_refused_with_its_field(own_bundle: Path, edit: Edit, expected: str) -> None:
    edit_manifest(own_bundle, edit)
    assert expected in refusal(own_bundle)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"x"', "\x00", "[" * 100_000])
def test_a_manifest_that_is_none_is_refused(own_bundle: Path, text: str) -> None:
    (own_bundle / "manifest.json").write_text(text)
    assert "manifest.json" in refusal(own_bundle)


def _rename_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = "obs"


def _narrow_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 59


def _fix_batch(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def _double(model: onnx.ModelProto) -> None:
    model.graph.output[0].type.tensor_type.elem_type = TensorProto.DOUBLE


def _second_output(model: onnx.ModelProto) -> None:
    model.graph.output.append(helper.make_tensor_value_info("raw", TensorProto.FLOAT, ["batch", 2]))


def _foreign_operators(model: onnx.ModelProto) -> None:
    model.opset_import.append(helper.make_opsetid("com.example", 1))


def _external(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL


def _external_in_a_subgraph(model: onnx.ModelProto) -> None:
    tensor = TensorProto(
        name="hidden", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL
    )
    constant = helper.make_node("Constant", [], ["hidden"], value=tensor)
    branch = helper.make_graph([constant], "branch", [], [])
    model.graph.node.append(
        helper.make_node("If", ["flag"], ["chosen"], then_branch=branch, else_branch=branch)
    )


def _external_in_a_function(model: onnx.ModelProto) -> None:
    tensor = TensorProto(name="hidden", data_type=TensorProto.FLOAT, dims=[1])
    tensor.external_data.add(key="location", value="/etc/passwd")
    model.functions.add(name="f").node.append(helper.make_node("Constant", [], ["hidden"], value=tensor))


def _external_in_a_sparse_tensor(model: onnx.ModelProto) -> None:
    model.graph.sparse_initializer.add().values.data_location = TensorProto.EXTERNAL


def _unknown_operator(model: onnx.ModelProto) -> None:
    model.graph.node[0].op_type = "Jemm"


def _missing_input(model: onnx.ModelProto) -> None:
    model.graph.node[0].input[0] = "nothing"


def _short_tensor(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].raw_data = model.graph.initializer[0].raw_data[:-4]


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (_rename_input, "input is 'obs'"),
        (_narrow_input, "[batch, 59], expected 'observation' float32 [batch, 60]"),
        (_fix_batch, "[1, 60], expected"),
        (_double, "'action' data type 11"),
        (_second_output, "'raw'"),
        (_foreign_operators, "com.example 1"),
        (_external, "external data"),
        (_external_in_a_subgraph, "external data"),
        (_external_in_a_function, "external data"),
        (_external_in_a_sparse_tensor, "external data"),
        (_unknown_operator, "not a valid ONNX model: No Op registered for Jemm"),
        (_missing_input, "not a valid ONNX model: Nodes in a graph must be topologically sorted"),
        (_short_tensor, "not a valid ONNX model"),
    ],
)
def test_a_graph_of_another_shape_is_refused(
    own_bundle: Path, edit: Callable[[onnx.ModelProto], Any], expected: str
) -> None:
    edit_graph(own_bundle, "policy.onnx", edit)
    message = refusal(own_bundle)
    assert "policy.onnx" in message
    assert expected in message


@pytest.mark.parametrize("data", [b"", b"hello, world", b"\xff" * 100, b"PK\x03\x04"])
def test_what_is_no_graph_is_refused(own_bundle: Path, data: bytes) -> None:
    replace_graph(own_bundle, "multiplier.onnx", data)
    assert "multiplier.onnx: not an ONNX model" in refusal(own_bundle)


def test_a_bundle_replaces_a_bundle_and_leaves_nothing_beside_it(own_bundle: Path) -> None:
    old = Bundle.load(own_bundle)
    renamed = old.manifest.model_copy(update={"algorithm": "another"})
    new = write_bundle(own_bundle, old.policy, old.multiplier, renamed)
    assert new.manifest.algorithm == "another"
    assert [path.name for path in own_bundle.parent.iterdir()] == ["tiny"]


def test_a_folder_that_is_no_bundle_is_not_replaced(own_bundle: Path, tmp_path: Path) -> None:
    bundle = Bundle.load(own_bundle)
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter.tex").write_text("precious")
    with pytest.raises(BundleError, match="not a bundle"):
        write_bundle(thesis, bundle.policy, bundle.multiplier, bundle.manifest)
    assert (thesis / "chapter.tex").read_text() == "precious"


def test_what_lies_in_a_bundles_folder_beside_it_is_not_lost(own_bundle: Path) -> None:
    bundle = Bundle.load(own_bundle)
    (own_bundle / "notes.txt").write_text("precious")
    with pytest.raises(BundleError, match=r"notes\.txt"):
        write_bundle(own_bundle, bundle.policy, bundle.multiplier, bundle.manifest)
    assert (own_bundle / "notes.txt").read_text() == "precious"


def test_a_bundle_that_would_not_load_is_not_written(own_bundle: Path, tmp_path: Path) -> None:
    bundle = Bundle.load(own_bundle)
    with pytest.raises(BundleError, match=r"swapped/policy\.onnx: output is 'multiplier'"):
        write_bundle(tmp_path / "swapped", bundle.multiplier, bundle.policy, bundle.manifest)
    with pytest.raises(BundleError, match="cut short"):
        write_bundle(tmp_path / "short", bundle.policy[:-40], bundle.multiplier, bundle.manifest)
    assert [path.name for path in tmp_path.iterdir()] == ["tiny"]


def test_the_old_bundle_survives_a_failed_replacement(own_bundle: Path) -> None:
    old = Bundle.load(own_bundle)
    with pytest.raises(BundleError):
        write_bundle(own_bundle, old.multiplier, old.policy, old.manifest)
    assert Bundle.load(own_bundle).id == old.id
