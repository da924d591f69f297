"""The closed loop runs each episode once, to its end, whatever else is simulated beside it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointgoal.loop import drive, groups, side_by_side
from pointgoal.vector import PointGoalVectorEnv


class Countdown:
    """Environments whose episode with seed s takes s steps and whose observation is the steps so far."""

    def __init__(self, count: int) -> None:
        self.num_envs = count
        self.resets: list[list[int]] = []

    def reset(self, seed):
        self.resets.append(list(seed))
        self.left, self.made = np.array(seed), np.zeros(len(seed))
        return self.made[:, None].copy(), {}

    def step(self, action):
        self.left, self.made = self.left - 1, self.made + 1
        done = self.left == 0
        info = {"cost": self.made.copy(), "final_obs": self.made[:, None].copy(), "_final_obs": done}
        self.made[done] = 0.0
        return self.made[:, None].copy(), np.ones(self.num_envs), done, np.zeros_like(done), info


@given(st.lists(st.integers(1, 9), min_size=1, max_size=12), st.integers(1, 5))
def test_each_episode_is_run_once_to_its_end(lengths: list[int], most: int) -> None:
    size = side_by_side(len(lengths), most)
    assert size <= most
    env, steps, last = Countdown(size), np.zeros(len(lengths), int), np.zeros(len(lengths))
    for part in groups(len(lengths), size):
        for step in drive(env, lambda observation, _: observation, lengths[part]):
            rows = part.start + np.flatnonzero(step.running)
            steps[rows] += 1
            last[rows] = step.after[step.running, 0]
            np.testing.assert_array_equal(step.observation[step.running, 0], steps[rows] - 1)
    assert steps.tolist() == last.tolist() == lengths
    assert all(len(seeds) == size for seeds in env.resets)


def test_an_episode_may_be_cut_short() -> None:
    assert len(list(drive(Countdown(2), lambda observation, _: observation, [9, 9], most=4))) == 4


@given(st.integers(1, 10_000), st.integers(1, 600))
def test_groups_are_nearly_equal(count: int, most: int) -> None:
    size = side_by_side(count, most)
    parts = groups(count, size)
    assert [i for part in parts for i in range(part.start, part.stop)] == list(range(count))
    assert len(parts) == -(-count // most)
    assert size * len(parts) - count < len(parts)


def test_the_last_observation_is_the_episodes_own() -> None:
    env = PointGoalVectorEnv(1, 2, num_threads=1)
    *_, last = drive(env, lambda observation, _: np.zeros((2, 2)), [5, 6])
    fresh, _ = env.reset(seed=[5, 6])
    # A robot at rest sees at the end what it saw at the start, but no new goal's place.
    assert last.running.all()
    assert last.after[:, 12:] == pytest.approx(last.observation[:, 12:], abs=1e-3)
    assert last.after[:, 12:] == pytest.approx(fresh[:, 12:], abs=1e-3)
