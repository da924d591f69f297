"""The filter in the real simulation: hostile and clumsy policies, and nobody enters a hazard."""

import gymnasium
import numpy as np
import pytest

from filter import FilterMemory, SafetyFilter
from pointgoal.vector import PointGoalVectorEnv


def attacker(hazards):
    nearest = hazards[np.arange(len(hazards)), np.linalg.norm(hazards, axis=2).argmin(axis=1)]
    return np.stack(
        [np.ones(len(hazards)), np.clip(4 * np.arctan2(nearest[:, 1], nearest[:, 0]), -1, 1)], axis=1
    )


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("policy", ["attacker", "random"])
def test_no_violation(robot_filter, source, policy):
    n = 48
    env = PointGoalVectorEnv(level=1, num_envs=n, num_threads=1)
    observation, _ = env.reset(seed=7)
    rng = np.random.default_rng(0)
    memory = FilterMemory.empty(n)
    changed = 0
    for _ in range(300):
        hazards = env.hazards_in_body_frame()
        action = attacker(hazards) if policy == "attacker" else rng.uniform(-1, 1, (n, 2))
        result = robot_filter.filter(observation, action, hazards if source == "given" else None, memory)
        memory = result.memory
        changed += int((result.mode > 0).sum())
        observation, _, _, _, info = env.step(result.action)
        assert (info["cost"] == 0.0).all()
    env.close()
    assert changed > 100


def test_wrapper_of_a_vector_environment_is_the_filter_by_hand(robot_filter):
    env = PointGoalVectorEnv(level=1, num_envs=4, num_threads=1)
    wrapped = SafetyFilter(PointGoalVectorEnv(level=1, num_envs=4, num_threads=1), hazards="lidar")
    observation, _ = env.reset(seed=3)
    wrapped.reset(seed=3)
    memory = FilterMemory.empty(4)
    rng = np.random.default_rng(1)
    for _ in range(60):
        action = rng.uniform(-1, 1, (4, 2))
        result = robot_filter.filter(observation, action, None, memory)
        memory = result.memory
        observation, reward, *_ = env.step(result.action)
        seen, told_reward, _, _, info = wrapped.step(action)
        np.testing.assert_array_equal(seen, observation)
        np.testing.assert_array_equal(told_reward, reward)
        np.testing.assert_array_equal(info["filter"]["action"], result.action)
    assert len(info["filter"]["mode"]) == 4


def test_wrapper_of_a_single_environment():
    env = SafetyFilter(gymnasium.make("PointGoal1-v0"))
    env.reset(seed=11)
    told = []
    for _ in range(400):
        hazards = env.unwrapped.hazards_in_body_frame()
        _, _, _, _, info = env.step(attacker(hazards[None])[0])
        assert info["cost"] == 0.0
        told.append(info["filter"]["mode"])
    assert {"nominal", "filtered"} <= set(told)
    assert info["filter"]["action"].shape == (2,)


def test_wrapper_refuses_what_it_cannot_wrap():
    with pytest.raises(TypeError, match="not a gymnasium environment"):
        SafetyFilter(object())
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(ValueError, match="hazards_in_body_frame"):
        SafetyFilter(env)
    with pytest.raises(ValueError, match="'given' or 'lidar'"):
        SafetyFilter(env, hazards="radar")


def test_other_levels(robot_filter):
    for level in (0, 2):
        env = PointGoalVectorEnv(level=level, num_envs=8, num_threads=1)
        observation, _ = env.reset(seed=1)
        for _ in range(60):
            result = robot_filter.filter(observation, np.tile([1.0, 0.2], (8, 1)))
            observation, *_ = env.step(result.action)
        if level == 2:
            assert np.linalg.norm(env.hazards_in_body_frame(), axis=2).min() > 0.2
        env.close()
