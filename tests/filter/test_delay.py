"""Old observations and late actions: the filter predicts through what is under way."""

from collections import deque

import numpy as np
import pytest

from decision import MEMORY, MOST_LATE, Mode
from filter import BarrierFilter, FilterConfig

N = 40


def violations(robot_filter, hand, drive, source, policy, old, late, told, steps=400):
    """Violating steps of robots whose observations are old and whose actions come late."""
    robot_filter = BarrierFilter(FilterConfig(delay_steps=told))
    rng, memory = np.random.default_rng(0), np.zeros(N, MEMORY)
    seen, sent, count, changed = deque(maxlen=old + 1), deque([np.zeros((N, 2))] * late), 0, 0
    for now in drive(steps, n=N):
        count += int((now.cost > 0.0).sum())
        seen.append((now.observation, now.hazards))
        observation, hazards = seen[0]
        action = getattr(hand, policy)(observation, hazards, rng)
        result = robot_filter.filter(observation, action, hazards if source == "given" else None, memory)
        memory = result.memory
        changed += int((result.mode != Mode.NOMINAL).sum())
        sent.append(result.action)
        now.action = sent.popleft()
    assert changed > 100
    return count


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize(("old", "late"), [(1, 0), (3, 0), (0, 2), (2, 3)])
def test_a_known_delay_costs_no_safety(robot_filter, hand, drive, source, old, late) -> None:
    assert violations(robot_filter, hand, drive, source, "attacker", old, late, old + late) == 0


def test_a_delay_that_is_not_told_does(robot_filter, hand, drive) -> None:
    assert violations(robot_filter, hand, drive, "given", "attacker", 0, 3, 0) > 10


def test_the_next_action_takes_effect_where_the_filter_says(robot_filter, hand, drive) -> None:
    """The exact model says to a few micrometres where the robot will be."""
    late = 3
    robot_filter = BarrierFilter(FilterConfig(delay_steps=late))
    rng, memory = np.random.default_rng(1), np.zeros(N, MEMORY)
    sent, predicted = deque([np.zeros((N, 2))] * late), deque()
    errors = []
    for now in drive(60, n=N):
        pose = now.env.pose
        predicted.append((pose, robot_filter.look(now.observation, None, memory).seen))
        if len(predicted) > late:
            before, seen = predicted.popleft()
            c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
            dx, dy = (pose - before)[:, :2].T
            where = np.stack([c * dx + s * dy, c * dy - s * dx], 1)
            errors.append(np.hypot(*(where - np.stack([seen["x"], seen["y"]], 1)).T))
            errors.append(np.abs(pose[:, 2] - before[:, 2] - seen["heading"]))
            errors.append(np.abs(now.observation[:, 3] - seen["vx"]))
            errors.append(np.abs(now.observation[:, 4] - seen["vy"]))
        result = robot_filter.filter(now.observation, hand.random(now.observation, None, rng), None, memory)
        memory = result.memory
        sent.append(result.action)
        now.action = sent.popleft()
    assert np.median(errors) < 1e-5
    # Vases are touched, and the servo chatters.
    assert np.quantile(errors, 0.95) < 2e-3
    assert np.median(np.abs([seen["x"] for _, seen in predicted])) > 1e-3


@pytest.mark.parametrize("steps", [-1, MOST_LATE + 1, 1.5, "1"])
def test_a_delay_is_a_few_whole_steps(steps) -> None:
    with pytest.raises(ValueError, match="delay_steps must be 0 to"):
        FilterConfig(delay_steps=steps)
