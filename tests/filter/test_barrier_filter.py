import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from filter import (
    SAFE_ACTION,
    BarrierFilter,
    FilterConfig,
    FilterInputError,
    FilterMemory,
    Mode,
    Row,
    committed_backup,
)


def batch(draw_scene, n, seed=0):
    rng = np.random.default_rng(seed)
    scenes = [draw_scene(rng) for _ in range(n)]
    return tuple(np.array(part) for part in zip(*scenes, strict=True))


def test_a_passing_action_is_the_nominal_one_bit_for_bit(robot_filter, draw_scene):
    observation, action, hazards = batch(draw_scene, 400)
    for given_hazards in (hazards, None):
        result = robot_filter.filter(observation, action, given_hazards)
        passed = result.mode == Mode.NOMINAL
        assert 20 < passed.sum() < 380
        np.testing.assert_array_equal(result.action[passed], action[passed])
        assert (result.hazard[passed] == -1).all()
        assert (result.row[passed] == Row.NONE).all()
        assert (result.hazard[~passed] >= 0).all()
        assert (result.row[~passed] != Row.NONE).all()
        texts = [reason is not None for reason in result.reason]
        np.testing.assert_array_equal(texts, result.mode == Mode.FALLBACK)


def test_a_batch_gives_what_single_robots_get(robot_filter, draw_scene):
    observation, action, hazards = batch(draw_scene, 700, seed=1)  # more than one chunk
    memory = FilterMemory.empty(700)
    for given_hazards in (hazards, None):
        for _ in range(2):
            together = robot_filter.filter(observation, action, given_hazards, memory)
            for k in range(0, 700, 23):
                row = slice(k, k + 1)
                own = FilterMemory(memory.side[row], memory.plan[row])
                alone = robot_filter.filter(
                    observation[row],
                    action[row],
                    None if given_hazards is None else given_hazards[row],
                    own,
                )
                for name in ("action", "mode", "barrier", "hazard", "row"):
                    np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[k])
                assert alone.memory.side[0] == together.memory.side[k]
                assert alone.memory.plan[0] == together.memory.plan[k]
            memory = together.memory


def brake_clearance(state, hazards, hand):
    """The most that a robot keeps of its distance to the hazards, braking or coasting, in the exact model."""
    best = -np.inf
    for law in ("coast", "brake"):
        at, least = np.array(state), np.inf
        for _ in range(120):
            least = min(least, np.linalg.norm(hazards - at[:2], axis=1).min())
            ahead = at[3] * np.cos(at[2]) + at[4] * np.sin(at[2])
            thrust = 0.0 if law == "coast" else -0.05 * np.clip(ahead / 0.06, -1, 1)
            at = hand.step_exactly(at, np.array([thrust, 0.0]))
        best = max(best, least)
    return best


def test_what_is_emitted_can_be_survived(robot_filter, draw_scene, hand):
    observation, action, hazards = batch(draw_scene, 20, seed=2)
    result = robot_filter.filter(observation, action, hazards)
    survived = 0
    for k in np.flatnonzero(result.mode != Mode.FALLBACK):
        start = np.array([0.0, 0.0, 0.0, *observation[k, 3:5], observation[k, 8]])
        after = hand.step_exactly(start, result.action[k])
        assert np.linalg.norm(hazards[k] - after[:2], axis=1).min() > 0.2
        survived += brake_clearance(after, hazards[k], hand) > 0.2
    # Most need no more than these two; some need a turn, which the closed loop tests.
    assert survived > 0.8 * (result.mode != Mode.FALLBACK).sum()


@settings(deadline=None, max_examples=60)
@given(
    depth=st.floats(0.0, 0.19),
    bearing=st.floats(-np.pi, np.pi),
    speed=st.floats(0.0, 0.5),
    course=st.floats(-np.pi, np.pi),
    scanned=st.booleans(),
)
def test_out_of_a_hazard(robot_filter, hand, depth, bearing, speed, course, scanned):
    distance = 0.2 - depth
    hazard = np.array([distance * np.cos(bearing), distance * np.sin(bearing)])
    at = np.array([0.0, 0.0, 0.0, speed * np.cos(course), speed * np.sin(course), 0.0])
    nominal = np.array([[1.0, 0.3]])
    for step in range(100):
        cos, sin = np.cos(at[2]), np.sin(at[2])
        turn = np.array([[cos, sin], [-sin, cos]])
        seen = (turn @ (hazard - at[:2]))[None]
        observation = hand.observe(seen, tuple(turn @ at[3:5]), at[5])[None]
        result = robot_filter.filter(observation, nominal, None if scanned else seen[None])
        if np.linalg.norm(seen) < 0.19:
            assert result.mode[0] == Mode.FALLBACK
            assert result.reason[0] is not None
            assert not np.array_equal(result.action, nominal)
        if step > 0 and np.linalg.norm(seen) >= 0.21:
            break
        at = hand.step_exactly(at, result.action[0])
    assert step < 90


@pytest.mark.parametrize("scanned", [False, True])
@pytest.mark.parametrize("offset", [0.0, 0.01, -0.1])
def test_a_robot_gets_past_what_stands_in_its_way_without_memory(robot_filter, hand, offset, scanned):
    # Two hazards that overlap, so that there is a notch to be caught in; the goal straight behind.
    hazards = np.array([[1.0, 0.17 + offset], [1.0, -0.17 + offset]])
    goal = np.array([2.2, 0.0])
    at = np.zeros(6)
    for _ in range(400):
        cos, sin = np.cos(at[2]), np.sin(at[2])
        turn = np.array([[cos, sin], [-sin, cos]])
        seen, ahead = (hazards - at[:2]) @ turn.T, turn @ (goal - at[:2])
        observation = hand.observe(seen, tuple(turn @ at[3:5]), at[5], ahead)[None]
        stop = ahead - 0.4 * turn @ at[3:5]
        nominal = np.array([[1.0, np.clip(4 * np.arctan2(stop[1], stop[0]), -1, 1)]])
        result = robot_filter.filter(observation, nominal, None if scanned else seen[None])
        at = hand.step_exactly(at, result.action[0])
        assert np.linalg.norm(hazards - at[:2], axis=1).min() > 0.2
        if np.linalg.norm(goal - at[:2]) < 0.3:
            return
    pytest.fail(f"stuck at {at[:2]}")


@pytest.mark.parametrize("front", [1.0, -1.0])
def test_either_end_of_the_robot_may_lead_the_way_round(robot_filter, hand, front):
    # The same scene ahead and astern, and a policy that would rather stay.
    hazards, goal = front * np.array([[0.6, 0.02]]), front * np.array([2.2, 0.0])
    for ahead in (0.0, 0.5):
        observation = hand.observe(hazards, (front * ahead, 0.0), 0.0, goal)[None]
        result = robot_filter.filter(observation, np.zeros((1, 2)), hazards[None])
        assert result.row[0] == Row.DETOUR
        assert front * result.action[0, 0] > 0.03
        assert 0.0 < abs(result.action[0, 1]) <= 1.0


def test_without_a_goal_the_robot_stops_in_front(robot_filter, hand):
    hazard = np.array([0.9, 0.0])
    at = np.zeros(6)
    for _ in range(150):
        seen = (hazard - at[:2])[None]
        result = robot_filter.filter(
            hand.observe(seen, (at[3], at[4]), 0.0)[None], np.array([[1.0, 0.0]]), seen[None]
        )
        at = hand.step_exactly(at, np.array([result.action[0, 0], 0.0]))
        at[2] = at[5] = 0.0
    assert 0.205 < np.linalg.norm(hazard - at[:2]) < 0.24


def test_where_the_gate_is_closed_the_nominal_action_passes(robot_filter, hand):
    hazards = np.array([[0.25, 0.0]])
    observation = np.repeat(hand.observe(hazards, (1.0, 0.0))[None], 2, axis=0)
    action = np.ones((2, 2))
    result = robot_filter.filter(observation, action, np.stack([hazards] * 2), active=[False, True])
    np.testing.assert_array_equal(result.action[0], action[0])
    assert result.mode.tolist() == [Mode.NOMINAL, Mode.FALLBACK]
    assert result.reason[1].startswith("too fast")
    assert result.barrier[0] == result.barrier[1] < 0.0


def test_absent_hazards_and_none_and_level_0(robot_filter):
    action = np.array([[0.7, -0.3]])
    for hazards in (np.full((1, 3, 2), np.nan), np.empty((1, 0, 2)), None):
        for size in (60, 28):
            result = robot_filter.filter(np.zeros((1, size)), action, hazards)
            np.testing.assert_array_equal(result.action, action)
            assert result.barrier[0] == 3.0
    assert robot_filter.filter(np.zeros((0, 60)), np.zeros((0, 2))).action.shape == (0, 2)


def test_which_hazard_and_which_row(robot_filter, hand):
    hazards = np.array([[-1.0, 0.4], [0.3, 0.02], [0.0, 1.0]])
    result = robot_filter.filter(
        hand.observe(hazards, (0.8, 0.0))[None], np.array([[1.0, 0.0]]), hazards[None]
    )
    assert result.hazard.tolist() == [1]
    assert result.row[0] in (Row.BARRIER, Row.SEARCH)
    scanned = robot_filter.filter(hand.observe(hazards, (0.8, 0.0))[None], np.array([[1.0, 0.0]]))
    assert scanned.hazard.tolist() == [0]  # the bin straight ahead


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_named(robot_filter, value):
    observation, action, hazards = np.zeros((1, 60)), np.zeros((1, 2)), np.zeros((1, 2, 2))
    bad = observation.copy()
    bad[0, 30] = value
    with pytest.raises(FilterInputError, match=r"^observation"):
        robot_filter.filter(bad, action)
    with pytest.raises(FilterInputError, match=r"^nominal_action"):
        robot_filter.filter(observation, np.full((1, 2), value))
    hazards[0, 1, 0] = value
    with pytest.raises(FilterInputError, match=r"^hazards"):
        robot_filter.filter(observation, action, hazards)


def test_shapes_are_named(robot_filter):
    observation, action = np.zeros((2, 60)), np.zeros((2, 2))
    cases = [
        ("observation", {"observation": np.zeros((2, 59))}),
        ("observation", {"observation": "words"}),
        ("nominal_action", {"nominal_action": np.zeros((3, 2))}),
        ("hazards", {"hazards": np.zeros((2, 2))}),
        ("active", {"active": [True]}),
        ("memory", {"memory": FilterMemory.empty(3)}),
    ]
    for field, change in cases:
        arguments = {"observation": observation, "nominal_action": action, **change}
        with pytest.raises(FilterInputError) as caught:
            robot_filter.filter(**arguments)
        assert caught.value.field == field


@pytest.mark.parametrize("name", ["daqp", "quadprog", "osqp"])
def test_any_solver_gives_the_same_actions(robot_filter, draw_scene, name):
    observation, action, hazards = batch(draw_scene, 150, seed=3)
    ours = robot_filter.filter(observation, action, hazards)
    theirs = BarrierFilter(FilterConfig(solver=name)).filter(observation, action, hazards)
    np.testing.assert_allclose(theirs.action, ours.action, atol=1e-5)
    np.testing.assert_array_equal(theirs.mode, ours.mode)


def test_a_solver_that_lies_is_not_believed(draw_scene):
    observation, action, hazards = batch(draw_scene, 150, seed=4)
    liar = BarrierFilter(FilterConfig(solver="daqp"))
    liar._solver = lambda problem: np.array([7.0, 0.0])
    silent = BarrierFilter(FilterConfig(solver="daqp"))
    silent._solver = lambda problem: None
    lied, said_nothing = (f.filter(observation, action, hazards) for f in (liar, silent))
    np.testing.assert_array_equal(lied.action, said_nothing.action)
    assert (lied.row != Row.BARRIER).all()


def test_wider_margins_keep_farther_off(robot_filter, draw_scene):
    observation, action, hazards = batch(draw_scene, 200, seed=5)
    plain = robot_filter.filter(observation, action, hazards).barrier
    for change in (
        {"margin": 0.03},
        {"bearing_error": 0.05},
        {"travel_error": 0.2},
        {"position_error": 0.02},
    ):
        assert (
            BarrierFilter(FilterConfig(**change)).filter(observation, action, hazards).barrier <= plain
        ).all()


@pytest.mark.parametrize(
    "change",
    [{"margin": -0.1}, {"margin": np.nan}, {"rate": 0.0}, {"hazard_radius": 0.0}, {"thrust_weight": -1.0}],
)
def test_settings_without_a_meaning_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        FilterConfig(**change)


def test_committed_backup(hand):
    np.testing.assert_array_equal(committed_backup(np.zeros(60)), SAFE_ACTION)
    hazard = np.array([[0.3, 0.0]])
    assert committed_backup(hand.observe(hazard, (0.8, 0.0)), hazard)[0] < 0.0
