import numpy as np
import pytest
from filter.backups import BACKUPS, STEPS, TURN, law
from filter.robot import Robot, State, advance, follow, stopping
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from filter.config import MODEL_ERROR, FilterConfig
from filter.config import settings as make_settings

ROBOT = Robot()
speeds = st.floats(-1.5, 1.5)
states = st.builds(State, st.just(0.0), st.just(0.0), st.just(0.0), speeds, speeds, st.floats(-3.0, 3.0))


@settings(deadline=None, max_examples=60)
@given(state=states, thrust=st.floats(-1.0, 1.0), turn=st.floats(-1.0, 1.0))
def test_step_is_the_mass_matrix_solved(hand, state, thrust, turn):
    after = advance(ROBOT, state, thrust, turn, ROBOT.substeps)
    np.testing.assert_allclose(after, hand.step_exactly(np.array(state), np.array([thrust, turn])), atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(state=states, turns=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20))
def test_without_thrust_the_robot_rests_at_its_stop_point_however_it_turns(state, turns):
    expected = stopping(ROBOT, state)
    for turn in turns:
        state = advance(ROBOT, state, 0.0, turn, ROBOT.substeps)
    for _ in range(400):
        state = advance(ROBOT, state, 0.0, 0.0, ROBOT.substeps)
    # The servo's chatter never quite rests, which moves the origin by some 0.01 mm.
    assert np.hypot(state.x - expected.zx, state.y - expected.zy) < 2e-3


@settings(deadline=None, max_examples=40)
@given(state=states, thrust=st.sampled_from([-1.0, -0.5, 0.0, 1.0]), turn=st.floats(-1.0, 1.0))
def test_reduced_model_follows_the_exact_one(state, thrust, turn):
    # For half a second, from any yaw rate to any other.
    reduced = stopping(ROBOT, state)
    for _ in range(25):
        state = advance(ROBOT, state, thrust * ROBOT.force_limit, turn, ROBOT.substeps)
        reduced = follow(ROBOT, reduced, thrust, turn)
        assert np.hypot(state.x - reduced.x, state.y - reduced.y) < 0.005


def test_full_turn_is_as_fast_as_the_servo_can(hand):
    state = np.zeros(6)
    for _ in range(50):
        state = hand.step_exactly(state, np.array([0.0, 1.0]))
    assert state[5] == pytest.approx(ROBOT.turn_rate, rel=2e-3)


def test_servo_that_holds_a_heading_gives_in_to_the_drag(hand):
    # Drifting sideways at 1 m/s: the drag behind the centre of mass turns the robot, 10 mrad in 0.4 s.
    state = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    reduced = stopping(ROBOT, State(*state))
    for _ in range(20):
        state = hand.step_exactly(state, np.zeros(2))
        reduced = follow(ROBOT, reduced, 0.0, 0.0)
    assert state[2] > 0.01
    assert reduced.heading == pytest.approx(state[2], abs=0.0015)


@settings(deadline=None, max_examples=400)
@given(
    state=states,
    action=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    kind=st.integers(0, BACKUPS - 1),
    steps=st.integers(0, STEPS),
)
def test_a_followed_plan_stays_near_the_path_that_was_certified(hand, state, action, kind, steps):
    # Turned to face sideways to the motion, the axis may be turned into it either way round.
    numbers = make_settings(FilterConfig())
    u1, u2 = action[0] * ROBOT.force_limit, action[1]
    middle = advance(ROBOT, state, u1, u2, ROBOT.substeps // 2)
    after = advance(ROBOT, middle, u1, u2, ROBOT.substeps // 2)
    at = stopping(ROBOT, after)
    across = abs((at.zx - at.x) * np.cos(at.heading) + (at.zy - at.y) * np.sin(at.heading))
    assume(kind != TURN or across > 0.01)
    path = [(0.0, 0.0), (middle.x, middle.y), (after.x, after.y)]
    for _ in range(steps):
        at = follow(ROBOT, at, *law(numbers, kind, at))
        path.append((at.x, at.y))
    path.append((at.zx, at.zy))
    real = np.array(hand.step_exactly(np.array(state), np.array([u1, u2])))
    for step in range(steps + 60):
        assert distance_to_path(real[:2], np.array(path)) < MODEL_ERROR
        share, turn = law(numbers, kind, stopping(ROBOT, State(*real))) if step < steps else (0.0, 0.0)
        real = hand.step_exactly(real, np.array([share * ROBOT.force_limit, turn]))


def distance_to_path(point, path):
    """Distance of a point (2,) from a polyline (n, 2)."""
    start, way = path[:-1], np.diff(path, axis=0)
    length = np.maximum((way**2).sum(axis=1), 1e-18)
    share = np.clip(((point - start) * way).sum(axis=1) / length, 0.0, 1.0)
    return np.linalg.norm(start + share[:, None] * way - point, axis=1).min()


def test_published_figures():
    assert ROBOT.time_constant == pytest.approx(0.519, abs=1e-3)
    assert ROBOT.stop_speed == pytest.approx(1.5)
    assert ROBOT.gear * ROBOT.force_limit / ROBOT.mass == pytest.approx(2.89, abs=1e-2)
    top = stopping(ROBOT, State(0.0, 0.0, 0.0, 1.5, 0.0, 0.0))
    assert top.zx == pytest.approx(0.78, abs=2e-3)
    at = top
    while at.zx > at.x:
        at = follow(ROBOT, at, -1.0, 0.0)
    assert at.x == pytest.approx(0.24, abs=5e-3)
