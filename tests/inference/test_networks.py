"""Both networks in one session: the numbers of two files, whichever way they are run."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from inference import Networks
from inference.trials import trials
from models import Bundle
from models.features import KEY, read

MODELS = Path(__file__).parents[2] / "models"
SHIPPED = sorted(path.parent.name for path in MODELS.glob("*/manifest.json"))
DESCRIBED = ["lagnet1", "pointgoal1"]
"""Those whose files say what their features are; in double and in single precision."""


def shipped(name: str) -> Bundle:
    return Bundle.load(MODELS / name)


def apart(bundle: Bundle, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the bundle's two files give, each run by itself."""
    feed = {"observation": observation.astype(np.float32)}
    action, risk = (by_itself(graph).run(None, feed)[0] for graph in (bundle.policy, bundle.multiplier))
    return action, risk


@cache
def by_itself(graph: bytes) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(graph)


def seen(count: int, size: int = 60) -> np.ndarray:
    rng = np.random.default_rng(1)
    observation = rng.normal(0.0, 1.0, (count, size))
    observation[:, 12:] = rng.random((count, size - 12)) * (rng.random((count, size - 12)) < 0.6)
    return observation


@pytest.fixture
def runs(monkeypatch) -> list[str]:
    """The input of every graph that onnxruntime is asked to run from here on."""
    made: list[str] = []

    class Told(onnxruntime.InferenceSession):
        def run(self, *arguments):
            made.append(self.get_inputs()[0].name)
            return super().run(*arguments)

        def run_with_iobinding(self, *arguments):
            made.append(self.get_inputs()[0].name)
            return super().run_with_iobinding(*arguments)

    monkeypatch.setattr("inference.session.onnxruntime.InferenceSession", Told)
    return made


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("count", [1, 64])
def test_one_session_gives_what_the_two_files_give(name: str, count: int, runs, caplog) -> None:
    bundle = shipped(name)
    observation = seen(count, bundle.manifest.observation_size)
    expected = apart(bundle, observation)
    networks = Networks(bundle)
    runs.clear()
    action, risk = networks.run(observation)
    assert len(runs) == 1
    assert (runs[0] != "observation") == (name in DESCRIBED)
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=5e-6)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-6, atol=1e-6)
    assert not caplog.records


CUT = {name: Networks(shipped(name)) for name in DESCRIBED}


@pytest.mark.parametrize("name", DESCRIBED)
@pytest.mark.parametrize("alone", [True, False])
def test_the_features_apart_change_nothing(name: str, alone: bool) -> None:
    bundle = shipped(name)
    numbers = read(onnx.load_from_string(bundle.policy))
    assert numbers is not None
    tried = trials(numbers)
    expected = apart(bundle, tried)
    if alone:
        answers = [CUT[name].run(tried[k : k + 1]) for k in range(len(tried))]
        action, risk = (np.concatenate(part) for part in zip(*answers, strict=True))
    else:
        action, risk = CUT[name].run(tried)
    assert 0 < np.isnan(action).any(axis=1).sum() < 0.1 * len(tried)  # beyond the precision, as in the graph
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-5, atol=1e-5)


@settings(max_examples=100, deadline=None)
@given(name=st.sampled_from(DESCRIBED), scale=st.floats(0.1, 5.0), seed=st.integers(0, 2**31))
def test_nor_on_any_observation(name: str, scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    observation = rng.normal(0.0, scale, (40, 60))
    shown = rng.choice((1.0, 0.5, rng.random()), (40, 48)) * rng.random((40, 48)).round(1)
    observation[:, 12:] = shown * (rng.random((40, 48)) < rng.random((40, 1)))
    action, risk = CUT[name].run(observation)
    expected = apart(CUT[name]._bundle, observation)
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-5, atol=1e-5)


def told(graph: bytes, change: Callable[[dict[str, Any]], object] | str | None) -> bytes:
    """A file that says something else of its features: a change to it, a text instead, or nothing."""
    model = onnx.load_from_string(graph)
    [entry] = [entry for entry in model.metadata_props if entry.key == KEY]
    if change is None:
        model.metadata_props.remove(entry)
    elif isinstance(change, str):
        entry.value = change
    else:
        said = json.loads(entry.value)
        change(said)
        entry.value = json.dumps(said)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def number(name: str, factor: float) -> Callable[[dict[str, Any]], object]:
    return lambda said: said.update({name: said[name] * factor})


def moved(name: str, place: int, by: float) -> Callable[[dict[str, Any]], object]:
    """One of the normaliser's numbers, moved by so many standard deviations or factors."""

    def change(said: dict[str, Any]) -> None:
        said[name][place] += by / said["inverse"][place] if name == "center" else by * said[name][place]

    return change


WRONG: dict[str, Callable[[dict[str, Any]], object] | str] = {
    **{name: number(name, 1.002) for name in ("limit", "gain", "length", "coasting", "sharpness")},
    **{f"center {k}": moved("center", k, 0.01) for k in range(0, 60, 6)},
    **{f"inverse {k}": moved("inverse", k, 0.01) for k in range(3, 60, 6)},
    "another tensor": lambda said: said.update(tensor="clamp"),
    "a tensor on the way": lambda said: said.update(tensor="cat_8"),
    "no tensor": lambda said: said.update(tensor="nowhere"),
    "the observation": lambda said: said.update(tensor="observation"),
    "after the features": lambda said: said.update(tensor="tanh"),
    "too few": lambda said: said.update(center=said["center"][:-1], inverse=said["inverse"][:-1]),
    "uneven": lambda said: said.update(center=said["center"][:-1]),
    "no length": number("length", 0.0),
    "another form": lambda said: said.update(form="other"),
    "more": lambda said: said.update(more=1.0),
    "missing": lambda said: said.pop("gain"),
    "no number": '{"gain": NaN}',
    "no JSON": "features",
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_not_so_is_not_trusted(what: str, runs, caplog) -> None:
    bundle = shipped("pointgoal1")
    observation = seen(50)
    expected = Networks(replace(bundle, policy=told(bundle.policy, None))).run(observation)
    assert not caplog.records
    change = WRONG[what]
    wrong = replace(bundle, policy=told(bundle.policy, change), multiplier=told(bundle.multiplier, change))
    networks = Networks(wrong)
    assert len(caplog.records) == 1
    assert caplog.records[0].name == "lagnet.inference"
    assert bundle.id in caplog.text
    assert "its graph computes the features" in caplog.text
    runs.clear()
    action, risk = networks.run(observation)
    assert runs == ["observation"]
    np.testing.assert_array_equal(action, expected[0])
    np.testing.assert_array_equal(risk, expected[1])


def test_two_files_that_differ_are_not_trusted(runs, caplog) -> None:
    bundle = shipped("pointgoal1")
    other = replace(bundle, multiplier=told(bundle.multiplier, moved("center", 3, 1e-7)))
    networks = Networks(other)
    assert "not the same" in caplog.text
    runs.clear()
    networks.run(seen(1))
    assert runs == ["observation"]


@pytest.mark.parametrize("silent", ["policy", "multiplier", "both"])
def test_files_that_say_nothing_of_it_run_as_they_are(silent: str, runs, caplog) -> None:
    bundle = shipped("pointgoal1")
    files = ["policy", "multiplier"] if silent == "both" else [silent]
    networks = Networks(replace(bundle, **{file: told(getattr(bundle, file), None) for file in files}))
    runs.clear()
    observation = seen(20)
    action, risk = networks.run(observation)
    assert runs == ["observation"]
    assert not caplog.records
    expected = apart(bundle, observation)
    np.testing.assert_array_equal(action, expected[0])
    np.testing.assert_array_equal(risk, expected[1])


@pytest.mark.parametrize("name", SHIPPED)
def test_pickled_they_are_the_same(name: str, runs) -> None:
    networks = Networks(shipped(name))
    copy = pickle.loads(pickle.dumps(networks))
    for count in (1, 30):
        runs.clear()
        both = [one.run(seen(count)) for one in (networks, copy)]
        assert len(runs) == 2
        assert runs[0] == runs[1]
        np.testing.assert_array_equal(both[0][0], both[1][0])
        np.testing.assert_array_equal(both[0][1], both[1][1])


def test_threads_do_not_get_each_others_answers() -> None:
    networks, observation = CUT["pointgoal1"], seen(400)
    expected = [networks.run(row[None]) for row in observation]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda row: networks.run(row[None]), observation))
    for one, other in zip(answers, expected, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_an_answer_is_the_callers_own() -> None:
    networks, (first, second) = CUT["pointgoal1"], seen(2)
    action, risk = networks.run(first[None])
    before = action.copy(), risk.copy()
    networks.run(second[None])
    np.testing.assert_array_equal(action, before[0])
    np.testing.assert_array_equal(risk, before[1])


def test_networks_that_cannot_be_joined_run_one_by_one(tiny_bundle: Path, runs) -> None:
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
    observation = seen(3)
    action, risk = Networks(replace(bundle, policy=model.SerializeToString())).run(observation)
    assert runs == ["observation"] * 2
    expected = apart(bundle, observation)
    np.testing.assert_allclose(action, expected[0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(risk, expected[1], rtol=1e-6, atol=1e-6)
