"""The gymnasium wrappers: the filter by hand, in the user's own loop."""

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import (
    ClipAction,
    FrameStackObservation,
    NormalizeObservation,
    OrderEnforcing,
    RecordEpisodeStatistics,
    RescaleAction,
    TimeLimit,
    TransformObservation,
)
from gymnasium.wrappers.vector import ClipAction as VectorClipAction
from gymnasium.wrappers.vector import RecordEpisodeStatistics as VectorRecordEpisodeStatistics

from decision import MEMORY, Mode
from filter import FilterConfig, SafetyFilter
from guide import Guide
from pointgoal.environment import PointGoalEnv
from pointgoal.vector import PointGoalVectorEnv

TOLD = {"action", "mode", "origin", "barrier", "hazard", "reason"}


def vector(n=4):
    return PointGoalVectorEnv(level=1, num_envs=n, num_threads=1)


def test_wrapper_of_a_vector_environment_is_the_filter_by_hand(robot_filter):
    env, wrapped = vector(), SafetyFilter(vector(), hazards="lidar")
    observation, _ = env.reset(seed=3)
    wrapped.reset(seed=3)
    memory = np.zeros(4, MEMORY)
    rng = np.random.default_rng(1)
    for _ in range(60):
        action = rng.uniform(-1, 1, (4, 2))
        result = robot_filter.filter(observation, action, None, memory)
        memory = result.memory
        observation, reward, *_ = env.step(result.action)
        seen, told_reward, _, _, info = wrapped.step(action)
        np.testing.assert_array_equal(seen, observation)
        np.testing.assert_array_equal(told_reward, reward)
        for name in TOLD - {"reason"}:
            np.testing.assert_array_equal(info["filter"][name], getattr(result, name))
        assert info["filter"]["reason"] == result.reason
    assert set(info["filter"]) == TOLD
    env.close()
    wrapped.close()


@pytest.mark.parametrize("guided", [False, True])
def test_wrapper_of_a_single_environment(hand, guided):
    env = SafetyFilter(gymnasium.make("PointGoal1-v0"), guide=Guide() if guided else None)
    observation, _ = env.reset(seed=11)
    told = []
    for _ in range(400):
        hazards = env.unwrapped.hazards_in_body_frame()[None]
        policy = hand.seeker if guided else hand.attacker
        observation, _, _, _, info = env.step(policy(observation[None], hazards, None)[0])
        assert info["cost"] == 0.0
        told.append(info["filter"])
    modes = {one["mode"] for one in told}
    assert {"nominal", "filtered"} <= modes
    assert (Mode.GUIDED in modes) == guided
    assert set(told[0]) == TOLD
    assert told[0]["action"].shape == (2,)
    assert all((one["origin"] is None) == (one["mode"] == "nominal") for one in told)
    env.close()


def test_wrapper_refuses_what_it_cannot_wrap():
    with pytest.raises(TypeError, match="not a gymnasium environment"):
        SafetyFilter(object())
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(ValueError, match="hazards_in_body_frame"):
        SafetyFilter(env)
    with pytest.raises(ValueError, match="'given' or 'lidar'"):
        SafetyFilter(env, hazards="radar")


def like_transform(env):
    return TransformObservation(env, lambda observation: 0.0 * observation, env.observation_space)


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (NormalizeObservation, "NormalizeObservation"),
        (like_transform, "TransformObservation"),
        (ClipAction, "ClipAction"),
        (lambda env: RescaleAction(env, -2.0, 2.0), "RescaleAction"),
        (lambda env: FrameStackObservation(env, 2), "FrameStackObservation"),
        (lambda env: TimeLimit(NormalizeObservation(env), 10), "NormalizeObservation"),
    ],
)
def test_wrappers_that_change_observations_or_actions_are_refused_with_the_fix(wrap, name):
    with pytest.raises(ValueError, match=rf"{name}\(SafetyFilter\(env\)\)"):
        SafetyFilter(wrap(PointGoalEnv(level=1)))


def test_a_vector_wrapper_that_changes_actions_is_refused():
    with pytest.raises(ValueError, match=r"ClipAction\(SafetyFilter\(env\)\)"):
        SafetyFilter(VectorClipAction(vector(2)))


def test_a_users_own_wrapper_is_refused_whatever_it_is_called():
    class TimeLimit(gymnasium.Wrapper):  # not gymnasium's
        def step(self, action):
            return self.env.step(-action)

    with pytest.raises(ValueError, match=r"TimeLimit\(SafetyFilter\(env\)\)"):
        SafetyFilter(TimeLimit(PointGoalEnv(level=1)))


def test_wrappers_that_change_neither_are_taken(hand):
    single = SafetyFilter(RecordEpisodeStatistics(OrderEnforcing(TimeLimit(PointGoalEnv(level=1), 20))))
    observation, _ = single.reset(seed=1)
    for _ in range(20):
        hazards = single.unwrapped.hazards_in_body_frame()[None]
        observation, _, _, truncated, info = single.step(hand.attacker(observation, hazards, None)[0])
    assert truncated
    assert info["episode"]["l"] == 20
    many = SafetyFilter(VectorRecordEpisodeStatistics(vector(2)))
    many.reset(seed=1)
    many.step(np.ones((2, 2)))


def test_the_fix_that_the_message_names_works():
    env = NormalizeObservation(SafetyFilter(PointGoalEnv(level=1)))
    env.reset(seed=0)
    *_, info = env.step(np.array([1.0, 0.0]))
    assert set(info["filter"]) == TOLD


def test_the_configuration_and_the_guide_reach_the_filter():
    env = SafetyFilter(PointGoalEnv(level=1), FilterConfig(margin=0.2))
    plain = SafetyFilter(PointGoalEnv(level=1))
    told = []
    for one in (env, plain):
        one.reset(seed=4)
        told.append(one.step(np.zeros(2))[-1]["filter"]["barrier"])
    assert told[0] < told[1] - 0.15


def test_a_reset_forgets_the_masked_rows_and_no_others(robot_filter, hand):
    # By hand beside it, once with the masked rows' memory forgotten, once with all, once with none.
    n = 12
    mask = np.arange(n) % 2 == 0
    wrapped = SafetyFilter(vector(n))
    observation, _ = wrapped.reset(seed=5)
    memory, different = np.zeros(n, MEMORY), {"all": 0, "none": 0}
    for step in range(400):
        hazards = wrapped.unwrapped.hazards_in_body_frame()
        action = hand.attacker(observation, hazards, None)
        expected = robot_filter.filter(observation, action, hazards, memory)
        if step % 40 == 39:
            before = memory
            memory = np.where(mask, np.zeros(n, MEMORY), memory)
            observation, _ = wrapped.reset(options={"reset_mask": mask})
            hazards = wrapped.unwrapped.hazards_in_body_frame()
            action = hand.attacker(observation, hazards, None)
            expected = robot_filter.filter(observation, action, hazards, memory)
            for name, other in (("all", np.zeros(n, MEMORY)), ("none", before)):
                would = robot_filter.filter(observation, action, hazards, other)
                different[name] += int((would.memory != expected.memory).any())
        observation, _, _, _, info = wrapped.step(action)
        np.testing.assert_array_equal(info["filter"]["action"], expected.action)
        memory = expected.memory
    assert different["all"] > 0  # or the test would not notice
    assert different["none"] > 0
    wrapped.close()


def test_the_end_of_an_episode_forgets_its_row(robot_filter, hand):
    wrapped = SafetyFilter(vector(2))
    observation, _ = wrapped.reset(seed=5, options={"elapsed_steps": np.array([990, 0])})
    memory = np.zeros(2, MEMORY)
    for _ in range(30):
        hazards = wrapped.unwrapped.hazards_in_body_frame()
        action = hand.attacker(observation, hazards, None)
        expected = robot_filter.filter(observation, action, hazards, memory)
        observation, _, terminated, truncated, info = wrapped.step(action)
        np.testing.assert_array_equal(info["filter"]["action"], expected.action)
        memory = np.where(terminated | truncated, np.zeros(2, MEMORY), expected.memory)
    wrapped.close()
