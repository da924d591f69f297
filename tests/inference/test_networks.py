"""Both networks in one session: the numbers of two, and a bundle whose networks cannot be joined runs too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from inference import Networks
from models import Bundle

SHIPPED = sorted((Path(__file__).parents[2] / "models").glob("*/manifest.json"))


def apart(bundle: Bundle, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the bundle's two files give, each run by itself."""
    feed = {"observation": observation.astype(np.float32)}
    action, risk = (
        onnxruntime.InferenceSession(str(path)).run(None, feed)[0]
        for path in (bundle.policy_path, bundle.multiplier_path)
    )
    return action, risk


def seen(count: int, size: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    observation = rng.normal(0.0, 1.0, (count, size))
    observation[:, 12:] = rng.random((count, size - 12)) * (rng.random((count, size - 12)) < 0.6)
    return observation


@pytest.fixture
def sessions(monkeypatch) -> list[object]:
    """What onnxruntime is asked to run from here on."""
    made: list[object] = []

    class Counted(onnxruntime.InferenceSession):
        def run(self, *arguments):
            made.append(self)
            return super().run(*arguments)

    monkeypatch.setattr("inference.networks.onnxruntime.InferenceSession", Counted)
    return made


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.parent.name)
@pytest.mark.parametrize("count", [1, 64])
def test_one_session_gives_what_the_two_files_give(path: Path, count: int, sessions) -> None:
    bundle = Bundle.load(path.parent)
    observation = seen(count, bundle.manifest.observation_size)
    expected = apart(bundle, observation)
    sessions.clear()
    action, risk = Networks(bundle).run(observation)
    assert len(sessions) == 1
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-6, atol=1e-6)


def test_networks_that_cannot_be_joined_run_one_by_one(tiny_bundle: Path, sessions) -> None:
    bundle = Bundle.load(tiny_bundle)
    model = onnx.load_from_string(bundle.policy)
    last = model.graph.node[-1].output[0]
    model.graph.node[-1].output[0] = "before"
    branch = helper.make_graph(
        [helper.make_node("Identity", ["before"], ["chosen"])],
        "branch",
        [],
        [helper.make_tensor_value_info("chosen", TensorProto.FLOAT, None)],
    )
    model.graph.initializer.append(helper.make_tensor("flag", TensorProto.BOOL, [], [True]))
    model.graph.node.append(helper.make_node("If", ["flag"], [last], then_branch=branch, else_branch=branch))
    observation = seen(3, 60)
    action, risk = Networks(replace(bundle, policy=model.SerializeToString())).run(observation)
    assert len(sessions) == 2
    expected = apart(bundle, observation)
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-6, atol=1e-6)
