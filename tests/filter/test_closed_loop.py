"""The filter in the real simulation: hostile and clumsy policies, and nobody enters a hazard."""

import gymnasium
import numpy as np
import pytest
from filter.backups import BACKUPS, law
from filter.robot import State, stopping

from filter import BarrierFilter, FilterConfig, FilterMemory, Mode, SafetyFilter
from filter.config import MODEL_ERROR, settings
from pointgoal.observation import HAZARD_RADIUS
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


def advance_exactly(state, action):
    """One control step (10 physics steps) of robots (N, 6); the origins on the way, (10, N, 2)."""
    m, inertia, c, h = 5.18879e-3, 2.84218275e-5, 1.927e-2, 0.002
    k, a, b = m * c, m + h * 0.01, inertia + h * 0.005
    x, y, heading, vx, vy, w = np.array(state).T
    way = []
    for _ in range(10):
        sin, cos = np.sin(heading), np.cos(heading)
        push = 0.3 * np.clip(action[:, 0], -0.05, 0.05) + k * w * w
        rx, ry = push * cos - 0.01 * vx, push * sin - 0.01 * vy
        torque = 0.3 * np.clip(action[:, 1] - 0.3 * w, -0.05, 0.05) - 0.005 * w
        spin = (torque + k * (sin * rx - cos * ry) / a) / (b - k * k / a)
        vx, vy, w = vx + h * (rx + k * sin * spin) / a, vy + h * (ry - k * cos * spin) / a, w + h * spin
        x, y, heading = x + h * vx, y + h * vy, heading + h * w
        way.append(np.stack([x, y], axis=1))
    return np.stack([x, y, heading, vx, vy, w], axis=1), np.array(way)


def least_distance_of_the_plan(state, action, plan, hazards):
    """Least distance (N,) to the true hazards (N, n, 2) under the action and then the whole plan."""
    numbers = settings(FilterConfig())
    backup, steps = (plan - 1) % BACKUPS, (plan - 1) // BACKUPS
    least = np.full(len(state), np.inf)
    for step in range(1 + steps.max() + 60):
        state, way = advance_exactly(state, action)
        gaps = np.linalg.norm(way[:, :, None] - hazards[None], axis=3).min(axis=(0, 2))
        least = np.minimum(least, gaps)
        action = np.zeros_like(action)
        for k in np.flatnonzero(step < steps):
            share, turn = law(numbers, backup[k], stopping(numbers.robot, State(*state[k])))
            action[k] = share * numbers.robot.force_limit, turn
    return least


def states_in_body_frame(env):
    pose, velocity = env.pose, env.velocity
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    ahead = cos * velocity[:, 0] + sin * velocity[:, 1]
    left = cos * velocity[:, 1] - sin * velocity[:, 0]
    zero = np.zeros(len(pose))
    return np.stack([zero, zero, zero, ahead, left, velocity[:, 2]], axis=1)


def first_actions(state, plan):
    """The next actions (N, 2) of plans (N,); zero without one."""
    numbers = settings(FilterConfig())
    action = np.zeros((len(plan), 2))
    for k in np.flatnonzero(plan > BACKUPS):
        share, turn = law(numbers, (plan[k] - 1) % BACKUPS, stopping(numbers.robot, State(*state[k])))
        action[k] = share * numbers.robot.force_limit, turn
    return action


def erratic(rng, n, step, last):
    """Nearly full thrust, and a turn that is held for a while: fast, and in no one's way."""
    if step % 25:
        return last
    return np.stack([rng.choice([1.0, 1.0, -1.0], n), rng.uniform(-0.6, 0.6, n)], axis=1)


@pytest.mark.parametrize(
    ("source", "policy", "margin", "steps"),
    [
        ("given", "attacker", 0.01, 100),
        ("lidar", "attacker", 0.01, 100),
        ("lidar", "erratic", 0.01, 100),
        # With no margin to give up, the plan alone carries the robot over what a new scan leaves possible.
        ("lidar", "attacker", MODEL_ERROR, 190),
        ("lidar", "erratic", MODEL_ERROR, 100),
    ],
)
def test_what_is_remembered_stays_clear_of_the_true_hazards_for_ever(source, policy, margin, steps):
    # The induction: whatever is sent, the plan that is remembered with it never comes near a hazard, though
    # the filter has seen nothing but scans. Robot and hazards are the true ones here.
    robot_filter = BarrierFilter(FilterConfig(margin=margin))
    n = 32
    env = PointGoalVectorEnv(level=1, num_envs=n, num_threads=1)
    observation, _ = env.reset(seed=70)
    rng = np.random.default_rng(0)
    memory = FilterMemory.empty(n)
    continued, action = 0, np.zeros((n, 2))
    for step in range(steps):
        hazards = env.hazards_in_body_frame()
        action = attacker(hazards) if policy == "attacker" else erratic(rng, n, step, action)
        result = robot_filter.filter(observation, action, hazards if source == "given" else None, memory)
        state, plan = states_in_body_frame(env), result.memory.plan.astype(int)
        assert (plan > 0).all()
        least = least_distance_of_the_plan(state, result.action, plan, hazards)
        assert least.min() > HAZARD_RADIUS
        certified = result.mode != Mode.FALLBACK
        assert least[certified].min() > HAZARD_RADIUS + margin - MODEL_ERROR
        # Where nothing keeps clear of all that the scan leaves possible, the last plan goes on.
        going_on = first_actions(state, memory.plan.astype(int))
        continued += int((~certified & (result.action == going_on).all(axis=1) & (memory.plan > 0)).sum())
        memory = result.memory
        observation, *_ = env.step(result.action)
    env.close()
    assert continued > 0 or margin > MODEL_ERROR


def test_nothing_in_reach_leaves_a_plan_to_coast(robot_filter):
    # Otherwise a scan that shows more than the last could find the robot without any plan.
    observation = np.zeros((1, 60))
    observation[0, 3] = 1.0
    result = robot_filter.filter(observation, np.array([[1.0, 0.0]]))
    assert result.memory.plan.tolist() == [1]
    assert robot_filter.filter(observation, np.array([[1.0, 0.0]]), active=[False]).memory.plan.tolist() == [
        0
    ]


def test_a_plan_that_was_left_is_forgotten(robot_filter, hand):
    # At 1.4 m/s towards a hazard that is 0.15 m away: nothing can be certified, and no old plan is any use.
    hazards = np.array([[0.35, 0.0]])
    observation = hand.observe(hazards, (1.4, 0.0))[None]
    old = FilterMemory(np.zeros(1, np.int8), np.array([1 + 0 + BACKUPS * 7], np.int8))
    known = robot_filter.filter(observation, np.zeros((1, 2)), hazards[None], old)
    assert known.mode[0] == Mode.FALLBACK
    assert known.memory.plan[0] == 0
    # With scans the plan may rest on what an earlier one ruled out: it is followed, and no longer than it is.
    for left in range(6, -1, -1):
        result = robot_filter.filter(observation, np.zeros((1, 2)), None, old)
        assert result.reason[0].startswith("no certified action")
        assert result.memory.plan[0] == 1 + BACKUPS * left
        np.testing.assert_array_equal(result.action[0], [0.05, 0.0])
        old = result.memory
    result = robot_filter.filter(observation, np.zeros((1, 2)), None, old)
    np.testing.assert_array_equal(result.action[0], [0.0, 0.0])
    # Inside a hazard no plan counts.
    inside = np.array([[0.1, 0.0]])
    result = robot_filter.filter(hand.observe(inside, (1.4, 0.0))[None], np.zeros((1, 2)), None, old)
    assert result.reason[0].startswith("inside")
    assert result.memory.plan[0] == 0
    # Without a plan to go on with, none is left behind.
    result = robot_filter.filter(observation, np.zeros((1, 2)))
    assert result.reason[0].startswith("too fast")
    assert result.memory.plan[0] == 0


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
