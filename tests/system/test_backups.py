"""The backups' laws: what was certified of them holds of the robot that follows them."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from decision import PLAN_STEPS
from filter.config import MODEL_ERROR
from system.backups import BACKUPS, FORWARD, REVERSE, TURN, law, steered
from system.point_robot import Robot, State, Stopping, advance, follow, stopping

ROBOT = Robot()
speeds = st.floats(-1.5, 1.5)
states = st.builds(State, st.just(0.0), st.just(0.0), st.just(0.0), speeds, speeds, st.floats(-3.0, 3.0))


@settings(deadline=None, max_examples=400)
@given(
    state=states,
    action=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    kind=st.integers(0, BACKUPS - 1),
    steps=st.integers(0, PLAN_STEPS),
)
def test_a_followed_plan_stays_near_the_path_that_was_certified(hand, state, action, kind, steps):
    # Turned to face sideways to the motion, the axis may be turned into it either way round.
    u1, u2 = action[0] * ROBOT.force_limit, action[1]
    middle = advance(ROBOT, state, u1, u2, ROBOT.substeps // 2)
    after = advance(ROBOT, middle, u1, u2, ROBOT.substeps // 2)
    at = stopping(ROBOT, after)
    across = abs((at.zx - at.x) * np.cos(at.heading) + (at.zy - at.y) * np.sin(at.heading))
    assume(kind != TURN or across > 0.01)
    path = [(0.0, 0.0), (middle.x, middle.y), (after.x, after.y)]
    for _ in range(steps):
        at = follow(ROBOT, at, *law(ROBOT, kind, at))
        path.append((at.x, at.y))
    path.append((at.zx, at.zy))
    real = np.array(hand.step_exactly(np.array(state), np.array([u1, u2])))
    for step in range(steps + 60):
        assert distance_to_path(real[:2], np.array(path)) < MODEL_ERROR
        share, turn = law(ROBOT, kind, stopping(ROBOT, State(*real))) if step < steps else (0.0, 0.0)
        real = hand.step_exactly(real, np.array([share * ROBOT.force_limit, turn]))


def distance_to_path(point, path):
    """Distance of a point (2,) from a polyline (n, 2)."""
    start, way = path[:-1], np.diff(path, axis=0)
    length = np.maximum((way**2).sum(axis=1), 1e-18)
    share = np.clip(((point - start) * way).sum(axis=1) / length, 0.0, 1.0)
    return np.linalg.norm(start + share[:, None] * way - point, axis=1).min()


@settings(deadline=None, max_examples=100)
@given(state=states, heading=st.floats(-np.pi, np.pi), kind=st.integers(0, BACKUPS - 1))
def test_a_law_gives_actions_within_the_box(state, heading, kind):
    share, turn = law(ROBOT, kind, stopping(ROBOT, state._replace(heading=heading)))
    assert abs(share) <= 1.0
    assert abs(turn) <= 1.0
    if kind != TURN:
        assert (share, turn) == ((1.0 if kind == FORWARD else -1.0), 0.0)


def test_at_rest_the_turn_does_nothing():
    assert law(ROBOT, TURN, Stopping(0.0, 0.0, 0.0, 0.0, 0.3, 0.0)) == (0.0, 0.0)


@pytest.mark.parametrize("ahead", [1.0, -1.0])
def test_the_one_against_the_motion_brakes(ahead):
    at = stopping(ROBOT, State(0.0, 0.0, 0.0, ahead, 0.0, 0.0))
    coast = abs(at.zx)
    kind = REVERSE if ahead > 0.0 else FORWARD
    for _ in range(10):
        at = follow(ROBOT, at, *law(ROBOT, kind, at))
    assert abs(at.zx) < coast - 0.25


@given(error=st.floats(-0.05, 0.05))
def test_steered_turns_by_the_error_within_a_step_or_near(error):
    state = advance(ROBOT, State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, steered(ROBOT, error), ROBOT.substeps)
    assert abs(state.heading - error) < 0.5 * abs(error) + 3e-3
