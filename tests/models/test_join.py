"""Two networks in one graph give what they give apart, and share what is equal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from models import Bundle, BundleError
from models.features import read, told, write
from models.join import join

SHIPPED = Path(__file__).parents[2] / "models" / "pointgoal1"


def run(graph: bytes, names: list[str], observation: np.ndarray) -> list[np.ndarray]:
    return onnxruntime.InferenceSession(graph).run(names, {"observation": observation})


@pytest.mark.parametrize("shipped", [True, False])
def test_joined_networks_give_what_they_give_apart(tiny_bundle: Path, shipped: bool) -> None:
    bundle = Bundle.load(SHIPPED if shipped else tiny_bundle)
    rng = np.random.default_rng(0)
    observation = rng.normal(0, 2, (200, 60)).astype(np.float32)
    observation[:, 12:] = rng.random((200, 48)) * (rng.random((200, 48)) < 0.6)
    joined = bundle.joined()
    onnx.checker.check_model(joined, full_check=True)
    action, multiplier = run(joined, ["action", "multiplier"], observation)
    np.testing.assert_array_equal(action, run(bundle.policy, ["action"], observation)[0])
    np.testing.assert_array_equal(multiplier, run(bundle.multiplier, ["multiplier"], observation)[0])


def test_what_the_shipped_networks_share_is_computed_once() -> None:
    bundle = Bundle.load(SHIPPED)
    count = {len(onnx.load_from_string(g).graph.node) for g in (bundle.policy, bundle.multiplier)}
    assert len(onnx.load_from_string(bundle.joined()).graph.node) < 1.2 * max(count)


def saying(graph: bytes, change: dict[str, object] | None) -> bytes:
    """A graph that says the same of its features but for a change; None: nothing."""
    model = onnx.load_from_string(graph)
    said = read(model)
    assert said is not None
    del model.metadata_props[:]
    if change is not None:
        write(model, said.model_copy(update=change))
    return bytes(model.SerializeToString())


def test_what_both_say_of_their_features_is_said_by_the_name_in_the_joined_graph() -> None:
    bundle = Bundle.load(SHIPPED)
    joined = onnx.load_from_string(bundle.joined())
    said, own = read(joined), read(onnx.load_from_string(bundle.policy))
    assert said is not None
    assert own is not None
    assert said.tensor != own.tensor
    assert said.model_copy(update={"tensor": own.tensor}) == own
    [made] = [node for node in joined.graph.node if said.tensor in node.output]
    taken = [node for node in joined.graph.node if said.tensor in node.input]
    assert made.op_type == "Concat"
    assert [node.op_type for node in taken] == ["Gemm", "Gemm"]


@pytest.mark.parametrize("change", [None, {"tensor": "clamp"}, {"tensor": "nowhere"}, {"gain": 4.5}])
def test_what_only_one_says_of_its_features_is_left_out(change: dict[str, object] | None) -> None:
    bundle = Bundle.load(SHIPPED)
    for graphs in (
        (bundle.policy, saying(bundle.multiplier, change)),
        (saying(bundle.policy, change), bundle.multiplier),
    ):
        assert not told(onnx.load_from_string(join(graphs)))


def test_a_graph_and_its_copy_under_another_output_share_all_but_the_end(tiny_bundle: Path) -> None:
    policy = Bundle.load(tiny_bundle).policy
    copy = onnx.load_from_string(policy)
    copy.graph.output[0].name = copy.graph.node[-1].output[0] = "again"
    joined = join((policy, copy.SerializeToString()))
    model, alone = onnx.load_from_string(joined), onnx.load_from_string(policy)
    assert len(model.graph.node) == len(alone.graph.node) + 1
    assert len(model.graph.initializer) == len(alone.graph.initializer)
    first, second = run(joined, ["action", "again"], np.ones((3, 60), np.float32))
    np.testing.assert_array_equal(first, second)


def test_a_graph_with_a_graph_inside_is_refused(tiny_bundle: Path) -> None:
    bundle = Bundle.load(tiny_bundle)
    model = onnx.load_from_string(bundle.policy)
    inside = helper.make_graph(
        [helper.make_node("Identity", ["raw"], ["chosen"])],
        "inside",
        [],
        [helper.make_tensor_value_info("chosen", TensorProto.FLOAT, None)],
    )
    model.graph.node.append(helper.make_node("If", ["flag"], ["out"], then_branch=inside, else_branch=inside))
    with pytest.raises(BundleError, match="subgraphs"):
        join((model.SerializeToString(), bundle.multiplier))
