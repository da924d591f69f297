import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from system.point_robot import ROBOT as RECORD
from system.point_robot import Robot, State, advance, follow, stopping

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


def test_the_record_of_compiled_code_has_every_constant():
    record = np.zeros(1, RECORD)
    record[0] = tuple(ROBOT)
    assert RECORD.names == Robot._fields
    assert [record[name][0] for name in RECORD.names] == list(ROBOT)
    assert ROBOT.control_step == pytest.approx(0.02)
