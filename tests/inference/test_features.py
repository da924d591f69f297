"""The features that compiled code computes are those that training computes in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inference import NetworkError
from inference.features import SIZE, Features
from inference.trials import trials
from pointgoal.observation import layout
from trainer import features as trained
from trainer.config import Config
from trainer.onnx_graph import exact, numbers

GOAL, HAZARDS = layout(1).slice("goal_lidar"), layout(1).slice("hazards_lidar")
VELOCITY = layout(1).slice("velocimeter")
PRECISIONS = [np.float32, np.float64]


def in_torch(nearness: float = 0.25) -> trained.Features:
    """Features as a run learns them, after some observations."""
    features = trained.Features(60, trained.surroundings(Config(nearness=nearness)))
    rng = np.random.default_rng(3)
    features.normaliser.update(rng.normal(rng.normal(0, 2, 60), rng.uniform(0.001, 3, 60), (500, 60)))
    return features


LEARNT = {nearness: in_torch(nearness) for nearness in (0.1, 0.25, 1.0)}


def both(observation: np.ndarray, nearness: float, real: type) -> tuple[np.ndarray, np.ndarray]:
    """The features by compiled code, and by torch."""
    learnt = LEARNT[nearness]
    torch_side = exact(learnt) if real is np.float64 else learnt
    seen = torch.from_numpy(observation.astype(np.float32)).to(torch_side.dtype)
    with torch.no_grad():
        expected = torch_side(seen).numpy()
    found = Features(numbers(learnt), real)(observation)
    assert found.dtype == real
    assert found.shape == (len(observation), SIZE)
    return found, expected


readings = arrays(np.float64, 16, elements=st.sampled_from([0.0, 1.0, 0.5]) | st.floats(0, 1))
"""Of a lidar, among them none at all, whole and equal ones."""


@st.composite
def observations(draw: st.DrawFn) -> np.ndarray:
    observation = draw(arrays(np.float64, 60, elements=st.floats(-20, 20)))
    observation[GOAL] = draw(st.just(np.zeros(16)) | readings)
    observation[HAZARDS] = draw(st.just(np.zeros(16)) | readings)
    return observation


@settings(max_examples=150, deadline=None)
@given(observation=observations(), nearness=st.sampled_from(sorted(LEARNT)), real=st.sampled_from(PRECISIONS))
def test_they_are_torchs_features(observation, nearness, real) -> None:
    found, expected = both(observation[None], nearness, real)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5 if real is np.float32 else 2e-6)


@pytest.mark.parametrize("real", PRECISIONS)
def test_they_are_torchs_features_on_what_is_tried_at_load(real) -> None:
    tried = trials(numbers(LEARNT[0.25]))
    assert 300 < len(tried) < 2000
    np.testing.assert_array_equal(tried, trials(numbers(LEARNT[0.25])))
    # Every kind is there that can go another way.
    goal, hazards = tried[:, GOAL], tried[:, HAZARDS]
    assert not tried[0].any()
    assert ((goal == goal.max(1, keepdims=True)).sum(1) > 1)[goal.any(1)].any()
    for count in (goal.any(1), hazards.any(1), (tried[:, VELOCITY] < 1e14).all(1)):
        assert 0 < count.sum() < len(tried)
    assert (tried[:, GOAL.start : HAZARDS.stop] == 1.0).any()
    sane = (np.abs(tried[:, VELOCITY]) < 100).all(1) & (np.abs(hazards) <= 1).all(1) & (goal >= 0).all(1)
    assert 200 < sane.sum() < len(tried)
    found, expected = both(tried[sane], 0.25, real)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("lidar", [GOAL, HAZARDS])
def test_they_are_torchs_features_where_bearings_are_many_turns(lidar) -> None:
    rng = np.random.default_rng(5)
    observation = rng.random((200, 60))
    observation[:, lidar] = -rng.random((200, 16))
    observation[np.arange(200), lidar.start + rng.integers(0, 16, 200)] = 1e-6
    found, expected = both(observation, 0.25, np.float32)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("real", PRECISIONS)
def test_a_row_of_a_batch_is_what_it_is_alone(real) -> None:
    features = Features(numbers(LEARNT[0.25]), real)
    tried = trials(numbers(LEARNT[0.25]))
    together = features(tried)
    for k in range(0, len(tried), 7):
        assert features(tried[k : k + 1]).tobytes() == together[k].tobytes()
    # However the caller's array lies in memory, and in whichever precision it is.
    assert features(np.asfortranarray(tried)).tobytes() == together.tobytes()
    assert features(tried[::-1])[::-1].tobytes() == together.tobytes()
    assert features(tried.astype(np.float32)).tobytes() == together.tobytes()


@pytest.mark.parametrize("shape", [(60,), (1, 59), (2, 28), (0, 61), (1, 1, 60)])
def test_what_is_no_observation_is_refused(shape) -> None:
    with pytest.raises(NetworkError, match=r"\[N, 60\]"):
        Features(numbers(LEARNT[0.25]), np.float32)(np.zeros(shape))


def test_no_robots_have_no_features() -> None:
    assert Features(numbers(LEARNT[0.25]), np.float32)(np.zeros((0, 60))).shape == (0, SIZE)
