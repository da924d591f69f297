"""Episodes add up to what single environments and single decisions give."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from decision import Mode, OpenedBy, Origin
from evaluation.closed_loop import TaskError, run_episodes
from monitor import Monitor
from pointgoal.observation import HAZARD_RADIUS
from pointgoal.seeds import Use, rows


def test_each_episode_is_that_of_a_single_environment(full_thrust) -> None:
    env = gymnasium.make("PointGoal1-v0")
    for i, seed in enumerate(rows(Use.EVALUATION, 7, 3)):
        env.reset(seed=seed)
        total, cost, violating = 0.0, 0.0, 0
        for _ in range(1000):
            _, reward, _, truncated, info = env.step(np.array([1.0, 0.25]))
            total, cost, violating = total + reward, cost + info["cost"], violating + (info["cost"] > 0)
        assert truncated
        assert full_thrust.returns[i] == pytest.approx(total, abs=1e-6)
        assert full_thrust.costs[i] == pytest.approx(cost, abs=1e-6)
        assert full_thrust.violating_steps[i] == violating


@pytest.mark.parametrize("hazards", ["lidar", "given"])
def test_the_loop_decides_as_a_robot_alone_would(always, hazards) -> None:
    """One robot's own loop, `decide` by `decide` with its memory, is a row of the many."""
    many = run_episodes("PointGoal1-v0", always, 2, seed=2, hazards=hazards, record=True)
    env = gymnasium.make("PointGoal1-v0").unwrapped
    observation, _ = env.reset(seed=rows(Use.EVALUATION, 2, 2)[1])
    memory, total, counts = None, 0.0, dict.fromkeys(Origin, 0)
    for t in range(1000):
        given = env.hazards_in_body_frame() if hazards == "given" else None
        decision = always.decide(observation, given, memory)
        memory = decision.memory
        np.testing.assert_allclose(decision.action, many.trajectory.action[t, 1], atol=1e-5)
        observation, reward, *_ = env.step(decision.action)
        total += reward
        if decision.origin is not None:
            counts[decision.origin] += 1
    assert total == pytest.approx(many.returns[1], abs=1e-3)
    assert counts == {origin: count[1] for origin, count in many.origins.items()}
    assert sum(counts.values()) > 0


def test_the_recording_tells_the_same(full_thrust) -> None:
    recorded = full_thrust.trajectory
    assert recorded.pose.shape == (1000, 3, 3)
    np.testing.assert_allclose(recorded.reward.sum(axis=0), full_thrust.returns)
    np.testing.assert_allclose(recorded.cost.sum(axis=0), full_thrust.costs)
    # A step's cost is the depth of the pose after it, which is the pose before the next.
    gaps = np.linalg.norm(recorded.pose[1:, :, None, :2] - recorded.hazards, axis=-1)
    depth = np.maximum(HAZARD_RADIUS - gaps, 0.0).sum(axis=-1)
    np.testing.assert_allclose(recorded.cost[:-1], depth, atol=1e-9)
    assert (recorded.mode[9::10] == Mode.FALLBACK).all()
    for cause, count in full_thrust.opened_by.items():
        np.testing.assert_array_equal((recorded.opened_by == cause).sum(axis=0), count)


def test_what_is_counted_is_what_was_decided(full_thrust) -> None:
    """The script of conftest: 1000 steps an episode."""
    steps = np.arange(1, 1001)
    fallback, filtered = steps % 10 == 0, (steps % 5 == 0) & (steps % 10 != 0)
    guided = (steps % 3 == 0) & (steps % 5 != 0)
    risk = fallback | guided | ((steps % 2 == 1) & ~filtered)
    for kind, expected in (
        (full_thrust.modes[Mode.FALLBACK], fallback),
        (full_thrust.modes[Mode.FILTERED], filtered),
        (full_thrust.modes[Mode.GUIDED], guided),
        (full_thrust.origins[Origin.PLAN], fallback),
        (full_thrust.origins[Origin.BARRIER], filtered),
        (full_thrust.origins[Origin.GUIDE], guided),
        (full_thrust.origins[Origin.HARM], np.zeros(1000)),
        (full_thrust.opened_by[OpenedBy.RISK], risk),
        (full_thrust.opened_by[OpenedBy.BARRIER], filtered),
        (full_thrust.opened_by[OpenedBy.ALWAYS], np.zeros(1000)),
        (full_thrust.certified_replaced, guided),
        (full_thrust.open_steps, risk | filtered),
        (full_thrust.interventions, fallback | filtered | guided),
    ):
        assert kind.tolist() == [expected.sum()] * 3


@pytest.mark.parametrize("gate", ["off", "risk", "always"])
def test_counts_add_up_for_a_real_monitor(tiny_bundle, gate) -> None:
    episodes = run_episodes("PointGoal1-v0", Monitor.load(tiny_bundle, gate), 2, seed=3)
    np.testing.assert_array_equal(sum(episodes.origins.values()), episodes.interventions)
    np.testing.assert_array_equal(sum(episodes.modes.values()), episodes.steps)
    np.testing.assert_array_equal(sum(episodes.opened_by.values()), episodes.open_steps)
    assert (episodes.certified_replaced <= episodes.interventions).all()
    assert (episodes.interventions <= episodes.open_steps).all()
    if gate != "risk":
        np.testing.assert_array_equal(episodes.open_steps, episodes.steps * (gate == "always"))


def test_a_decision_is_timed_as_one_robot_calls_it(scripted, monkeypatch) -> None:
    monkeypatch.setattr("evaluation.closed_loop._TIMED_STATES", 40)
    decider = scripted()
    episodes = run_episodes("PointGoal1-v0", decider, 2, hazards="given")
    assert decider.singles == 41  # the first one, which may have to connect, is not timed
    assert len(episodes.seconds) == 40
    assert min(episodes.seconds) > 0.0


def test_more_episodes_than_fit_side_by_side(always, monkeypatch) -> None:
    whole = run_episodes("PointGoal1-v0", always, 3, seed=4)
    monkeypatch.setattr("evaluation.closed_loop.SIDE_BY_SIDE", 2)
    steps = []
    parts = run_episodes("PointGoal1-v0", always, 3, seed=4, progress=steps.append)
    np.testing.assert_allclose(whole.returns, parts.returns, atol=1e-9)
    for mode in Mode:
        np.testing.assert_array_equal(whole.modes[mode], parts.modes[mode])
    assert sum(steps) == parts.steps.sum() == 3000
    assert len(parts.seconds) == len(whole.seconds) == 1000
    with pytest.raises(ValueError, match="recorded"):
        run_episodes("PointGoal1-v0", always, 3, record=True)


@pytest.mark.parametrize("task", ["PointGoal9-v0", "CartPole-v1", "nonsense"])
def test_a_task_that_is_not_ours_is_refused(task: str, always) -> None:
    with pytest.raises(TaskError, match=task):
        run_episodes(task, always, 1)


def test_no_episode_is_none(always) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        run_episodes("PointGoal1-v0", always, 0)
