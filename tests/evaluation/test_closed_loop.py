"""Episodes add up to what single environments give, and the service decides as the monitor in process."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest

from evaluation.closed_loop import TaskError, run_episodes
from evaluation.deciders import OverHttp
from evaluation.service import Service
from filter import Mode
from pointgoal.observation import HAZARD_RADIUS, layout
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


def test_the_service_decides_as_the_monitor(tiny_bundle: Path, always) -> None:
    here = run_episodes("PointGoal1-v0", always, 3, seed=1, hazards="lidar", record=True)
    with (
        Service.start(tiny_bundle, "always") as service,
        OverHttp(service.url, layout(1).to_json(), 5.0) as robots,
    ):
        there = run_episodes("PointGoal1-v0", robots, 3, seed=1, hazards="lidar", record=True)
    assert len(there.seconds) == 3000
    assert (here.modes[:, Mode.FILTERED] + here.modes[:, Mode.FALLBACK]).sum() > 0
    np.testing.assert_array_equal(here.modes, there.modes)
    np.testing.assert_array_equal(here.trajectory.action, there.trajectory.action)
    np.testing.assert_array_equal(here.returns, there.returns)


def test_more_episodes_than_fit_side_by_side(always, monkeypatch) -> None:
    whole = run_episodes("PointGoal1-v0", always, 3, seed=4)
    monkeypatch.setattr("evaluation.closed_loop.SIDE_BY_SIDE", 2)
    parts = run_episodes("PointGoal1-v0", always, 3, seed=4)
    np.testing.assert_allclose(whole.returns, parts.returns, atol=1e-9)
    assert len(parts.seconds) > len(whole.seconds) > 0
    with pytest.raises(ValueError, match="recorded"):
        run_episodes("PointGoal1-v0", always, 3, record=True)


@pytest.mark.parametrize("task", ["PointGoal9-v0", "CartPole-v1", "nonsense"])
def test_a_task_that_is_not_ours_is_refused(task: str, always) -> None:
    with pytest.raises(TaskError, match=task):
        run_episodes(task, always, 1)
