"""λ fitted to warn: what it is fitted to, on which states, and that it then knows more than a coin."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import mannwhitneyu

from decision import MEMORY
from pointgoal import seeds
from pointgoal.seeds import Use
from trainer import warning
from trainer.config import Config
from trainer.features import Features, surroundings
from trainer.warning import HORIZON, KINDS, Kind, WarningConfig, fit, gather, nearness

ROOT = Path(__file__).parents[2]
LIMIT = np.array([0.05, 1.0], np.float32)
TINY = WarningConfig(episodes=2, minibatches=400, minibatch=500)


@pytest.fixture(scope="module")
def policy():
    """The shipped policy that knows nothing of costs."""
    session = onnxruntime.InferenceSession(str(ROOT / "models" / "ppo1" / "policy.onnx"))
    return lambda observation: session.run(None, {"observation": observation})[0]


@settings(max_examples=50)
@given(
    cost=arrays(np.float64, (HORIZON + 25, 2), elements=st.sampled_from([0.0, 0.0, 0.0, 0.15, 1.0])),
    lonely=st.lists(st.integers(0, HORIZON + 25), max_size=3),
    discount=st.floats(0.5, 1.0),
)
def test_nearness_is_the_discounted_maximum_as_far_as_the_policy_drove_alone(cost, lonely, discount) -> None:
    alone = np.ones(cost.shape, bool)
    for t in lonely:
        alone[t : t + 5, 0] = False
    target, known = nearness(cost, alone, discount)
    for e in range(2):
        for t in range(len(cost)):
            ends = [k for k in range(t, len(cost)) if not alone[k, e]]
            end = min(ends, default=len(cost))
            assert known[t, e] == (end - t >= HORIZON)
            if known[t, e]:
                expected = max(discount ** (k - t) * cost[k, e] for k in range(t, end))
                assert target[t, e] == pytest.approx(expected)
    assert known[:25].any()
    assert not known[-HORIZON + 1 :].any()


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[2], Kind(True, True, True), Kind(False, True, False)])
def test_states_are_those_of_the_policy_alone(kind: Kind, policy, monkeypatch) -> None:
    driven, filtered = [], []
    decide = warning.BarrierFilter.decide

    def spied(self, view, nominal, memory, active):
        driven.append(view.observation.astype(np.float32))
        filtered.append(active.copy())
        assert memory.dtype == MEMORY
        return decide(self, view, nominal, memory, active)

    monkeypatch.setattr(warning.BarrierFilter, "decide", spied)
    rng = np.random.default_rng(0)
    layouts = seeds.rows(Use.WARNING, 77, 3)
    observation, target = gather(policy, 1, LIMIT, kind, layouts, TINY, rng)
    assert len(observation) == len(target)
    assert ((target >= 0.0) & (target <= 1.0)).all()
    assert (target == 1.0).any()
    assert (target == 0.0).any()
    if not kind.filtered:
        assert not driven
        assert len(observation) == 3 * (1000 - HORIZON + 1)
        return
    alone = ~np.array(filtered)
    assert 0.2 < alone.mean() < 0.95
    # Every state was one that the policy drove on from alone.
    there = {row.tobytes() for row in np.array(driven)[alone]}
    assert {row.tobytes() for row in observation} <= there
    assert 500 < len(observation) < alone.sum()


def test_disturbed_robots_do_something_else_within_the_bounds() -> None:
    rng = np.random.default_rng(1)
    disturbance = warning._Disturbance(200, LIMIT, rng)
    action = np.tile([0.02, -0.3], (200, 1))
    sent = np.array([disturbance(action) for _ in range(100)])
    assert (np.abs(sent) <= LIMIT + 1e-9).all()
    untouched = (sent == action).all(axis=(0, 2))
    assert 0.25 < untouched.mean() < 0.55
    changes = sent[:, ~untouched]
    kicks = (changes[1:] == changes[:-1]).all(axis=2) & (np.abs(changes[1:]) < LIMIT).all(axis=2)
    assert kicks.any()


def test_the_fitted_multiplier_tells_near_from_far(policy) -> None:
    features = Features(60, surroundings(Config(task="PointGoal1-v0")))
    features.requires_grad_(False)
    shares = []
    found, figures = fit(policy, features, 1, LIMIT, TINY, 5, shares.append)
    assert shares == sorted(shares)
    rng = np.random.default_rng(2)
    observation, target = gather(policy, 1, LIMIT, KINDS[0], seeds.rows(Use.WARNING, 99, 4), TINY, rng)
    with torch.no_grad():
        score = found(features(torch.from_numpy(observation))).numpy()
    assert ((score >= 0.0) & (score <= 1.0)).all()
    near = target > 0.5
    auroc = mannwhitneyu(score[near], score[~near]).statistic / (near.sum() * (~near).sum())
    assert auroc > 0.9
    assert figures["warning_states"] > 5000


@pytest.mark.long
def test_a_fit_is_repeated_bit_for_bit(policy) -> None:
    features = Features(60, surroundings(Config(task="PointGoal1-v0")))
    features.requires_grad_(False)
    one, again = (fit(policy, features, 1, LIMIT, TINY, 5)[0] for _ in range(2))
    assert torch.equal(one.parameters, again.parameters)
