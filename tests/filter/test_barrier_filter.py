"""Nominal action in, certified action out: what holds of every decision of the filter alone."""

import threading
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from decision import MEMORY, PLAN_STEPS, Decisions, Mode, Origin, next_of_plan
from filter import BarrierFilter, FilterConfig, FilterInputError

REPLACED = (Origin.BARRIER, Origin.CIRCULATION, Origin.SEARCH, Origin.PLAN, Origin.HARM)
near = st.tuples(st.floats(0.15, 1.6), st.floats(-np.pi, np.pi)).map(
    lambda polar: (polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]))
)
controls = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))


@pytest.fixture(scope="module")
def pressed(robot_filter):
    """Draws N robots under full thrust whose action the QP corrects."""

    def draw(n, seed=0):
        rng = np.random.default_rng(seed)
        speed = rng.uniform(0.2, 1.2, 10 * n)
        ahead = 0.21 + 0.115 * speed**2 + rng.uniform(0.0, 0.06, 10 * n)
        observation = np.zeros((10 * n, 60))
        observation[:, 3] = speed
        hazards = np.stack([ahead, rng.uniform(-0.1, 0.1, 10 * n)], axis=1)[:, None]
        action = np.stack([np.ones(10 * n), rng.uniform(-0.5, 0.5, 10 * n)], axis=1)
        chosen = np.flatnonzero(robot_filter.filter(observation, action, hazards).mode == Mode.FILTERED)[:n]
        assert len(chosen) == n
        return observation[chosen], action[chosen], hazards[chosen]

    return draw


@st.composite
def remembered(draw):
    """A memory (1,) of whatever kind."""
    memory = np.zeros(1, MEMORY)
    memory["side"], memory["guided"] = draw(st.integers(-50, 50)), draw(st.integers(-1, 1))
    memory["left"] = draw(st.integers(0, PLAN_STEPS))
    memory["plan"][0, : memory["left"][0]] = draw(controls)
    return memory


@settings(deadline=None, max_examples=400)
@given(
    hazards=st.lists(near, max_size=6),
    velocity=st.tuples(st.floats(0.0, 1.5), st.floats(-np.pi, np.pi)),
    yaw_rate=st.floats(-3.0, 3.0),
    action=controls,
    memory=remembered(),
    scanned=st.booleans(),
)
def test_a_certified_action_is_never_replaced_and_whatever_is_names_its_origin(
    robot_filter, hand, hazards, velocity, yaw_rate, action, memory, scanned
):
    at = np.array(hazards).reshape(-1, 2)
    motion = velocity[0] * np.cos(velocity[1]), velocity[0] * np.sin(velocity[1])
    observation = hand.observe(at, motion, yaw_rate)[None]
    nominal = np.array([action])
    decided = robot_filter.filter(observation, nominal, None if scanned else at[None], memory)
    one = decided[0]
    if one.certified:
        assert decided.action.tobytes() == nominal.tobytes()
        assert one.mode == Mode.NOMINAL
        assert one.hazard is None
    else:
        assert one.mode in (Mode.FILTERED, Mode.FALLBACK)
        assert one.hazard is not None
    assert (one.origin is None) == (one.mode == Mode.NOMINAL)
    assert one.origin in (None, *REPLACED)
    assert (one.origin in (Origin.PLAN, Origin.HARM)) == (one.mode == Mode.FALLBACK)
    assert (one.reason is None) == (one.mode != Mode.FALLBACK)
    assert (np.abs(one.action) <= 1.0).all()
    assert (np.abs(one.plan) <= 1.0).all()


def test_a_passing_action_is_the_nominal_one_bit_for_bit(robot_filter, scenes):
    observation, action, hazards = scenes(400)
    for given_hazards in (hazards, None):
        result = robot_filter.filter(observation, action, given_hazards)
        passed = result.mode == Mode.NOMINAL
        assert 20 < passed.sum() < 380
        np.testing.assert_array_equal(passed, result.certified)
        np.testing.assert_array_equal(result.action[passed], action[passed])
        assert (result.hazard[passed] == -1).all()
        assert (result.origin[passed] == "").all()
        assert (result.hazard[~passed] >= 0).all()
        assert np.isin(result.origin[~passed], REPLACED).all()
        texts = [reason is not None for reason in result.reason]
        np.testing.assert_array_equal(texts, result.mode == Mode.FALLBACK)
        np.testing.assert_array_equal(result.nominal_action, action)
        assert np.isnan(result.risk).all()
        assert (result.opened_by == "always").all()


@pytest.mark.parametrize("scanned", [False, True])
def test_the_plan_goes_on_to_be_certified(robot_filter, hand, scenes, scanned):
    # What is left of a certified backup is a certified backup, of the true robot as well.
    observation, action, hazards = scenes(300, seed=9)
    first = robot_filter.filter(observation, action, None if scanned else hazards)
    assert ((first.memory["left"] >= 0) & (first.memory["left"] <= PLAN_STEPS)).all()
    assert (np.abs(first.memory["plan"][..., 0]) <= 0.05 + 1e-12).all()
    assert (np.abs(first.memory["plan"][..., 1]) <= 1.0).all()
    state = np.zeros((300, 6))
    state[:, 3:5], state[:, 5] = observation[:, 3:5], observation[:, 8]
    memory, sound = first.memory, np.flatnonzero(first.mode != Mode.FALLBACK)
    state, action = hand.advance_exactly(state, first.action)[0], None
    for _ in range(4):
        seen = np.array([hand.in_body_frame(state[k], hazards[k]) for k in sound])
        motion = [
            hand.in_body_frame(np.array([0.0, 0.0, state[k, 2]]), state[k, None, 3:5])[0] for k in sound
        ]
        now = np.array(
            [hand.observe(at, tuple(v), state[k, 5]) for at, v, k in zip(seen, motion, sound, strict=True)]
        )
        action, memory = next_of_plan(memory)
        decided = robot_filter.filter(now, action[sound], None if scanned else seen, memory[sound])
        assert (decided.origin != Origin.HARM).all()
        assert (decided.mode == Mode.NOMINAL).mean() > 0.8
        state = hand.advance_exactly(state, action)[0]


def test_a_batch_gives_what_single_robots_get(robot_filter, scenes):
    observation, action, hazards = scenes(700, seed=1)  # more than one chunk
    memory = np.zeros(700, MEMORY)
    for given_hazards in (hazards, None):
        for _ in range(2):
            together = robot_filter.filter(observation, action, given_hazards, memory)
            for k in range(0, 700, 23):
                row = slice(k, k + 1)
                alone = robot_filter.filter(
                    observation[row],
                    action[row],
                    None if given_hazards is None else given_hazards[row],
                    memory[row],
                )
                for name in ("action", "mode", "barrier", "hazard", "origin", "certified", "memory"):
                    np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[k])
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


def test_what_is_emitted_can_be_survived(robot_filter, scenes, hand):
    observation, action, hazards = scenes(20, seed=2)
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


def test_which_hazard_and_which_origin(robot_filter, hand):
    hazards = np.array([[-1.0, 0.4], [0.3, 0.02], [0.0, 1.0]])
    result = robot_filter.filter(
        hand.observe(hazards, (0.8, 0.0))[None], np.array([[1.0, 0.0]]), hazards[None]
    )
    assert result.hazard.tolist() == [1]
    assert result.origin.tolist() == [Origin.CIRCULATION]
    straight = BarrierFilter(FilterConfig(circulation=0.0)).filter(
        hand.observe(hazards, (0.8, 0.0))[None], np.array([[1.0, 0.0]]), hazards[None]
    )
    assert straight.origin.tolist() == [Origin.BARRIER]
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
        ("memory", {"memory": np.zeros(3, MEMORY)}),
        ("memory", {"memory": np.zeros(2)}),
        ("memory", {"memory": [0, 0]}),
    ]
    for field, change in cases:
        arguments = {"observation": observation, "nominal_action": action, **change}
        with pytest.raises(FilterInputError) as caught:
            robot_filter.filter(**arguments)
        assert caught.value.field == field


def padded(scene):
    """The same with 8 hazards, of which those that are NaN are none."""
    observation, action, hazards = scene
    absent = np.full((len(hazards), 8 - hazards.shape[1], 2), np.nan)
    return observation, action, np.concatenate([absent, hazards], axis=1)


@pytest.mark.parametrize("name", ["daqp", "quadprog", "osqp"])
@pytest.mark.parametrize("circulation", [0.0, 0.7])
def test_any_solver_gives_the_same_actions(scenes, pressed, name, circulation):
    observation, action, hazards = (
        np.concatenate(parts) for parts in zip(padded(pressed(60)), scenes(150, seed=3), strict=True)
    )
    robot_filter = BarrierFilter(FilterConfig(circulation=circulation))
    ours = robot_filter.filter(observation, action, hazards)
    theirs = BarrierFilter(FilterConfig(solver=name, circulation=circulation)).filter(
        observation, action, hazards
    )
    # OSQP iterates: along a row of a small gradient it ends a little off.
    atol = 1e-4 if name == "osqp" else 1e-5
    np.testing.assert_allclose(theirs.action, ours.action, atol=atol)
    np.testing.assert_array_equal(theirs.mode, ours.mode)
    np.testing.assert_array_equal(theirs.origin, ours.origin)
    assert np.isin(ours.origin, (Origin.BARRIER, Origin.CIRCULATION)).sum() >= 55


def test_a_solver_that_lies_is_not_believed(pressed):
    observation, action, hazards = pressed(60, seed=4)
    liar = BarrierFilter(FilterConfig(solver="daqp"))
    liar._solver = lambda problem: np.array([7.0, 0.0])
    silent = BarrierFilter(FilterConfig(solver="daqp"))
    silent._solver = lambda problem: None
    lied, said_nothing = (f.filter(observation, action, hazards) for f in (liar, silent))
    np.testing.assert_array_equal(lied.action, said_nothing.action)
    assert (lied.mode != Mode.NOMINAL).all()
    assert (lied.origin == Origin.SEARCH).sum() > 30
    assert not np.isin(lied.origin, (Origin.BARRIER, Origin.CIRCULATION)).any()


def in_threads(robot_filter, parts):
    """What a filter gives for scenes, one thread for each of them, all at once."""
    results: list[Decisions | None] = [None] * len(parts)
    start = threading.Barrier(len(parts))

    def work(k):
        start.wait()
        results[k] = robot_filter.filter(*parts[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(parts))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def test_four_threads_get_what_one_gets(pressed, monkeypatch):
    """And no two share a workspace of OSQP: it lets go of the interpreter while it writes there."""
    import osqp

    update = osqp.OSQP.update
    users: dict[int, set[int]] = defaultdict(set)
    kept = []

    def slow_update(self, **changes):
        users[id(self)].add(threading.get_ident())
        kept.append(self)  # an address is not given twice
        # Between what is written to a workspace and its solution, every other thread has its turn.
        result = update(self, **changes)
        threading.Event().wait(0.002)
        return result

    monkeypatch.setattr(osqp.OSQP, "update", slow_update)
    parts = [pressed(8, seed=20 + k) for k in range(4)]
    robot_filter = BarrierFilter(FilterConfig(solver="osqp"))
    alone = [robot_filter.filter(*part) for part in parts]
    assert all((result.mode == Mode.FILTERED).all() for result in alone)
    together = in_threads(robot_filter, parts)
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_allclose(other.action, one.action, atol=1e-5)
        np.testing.assert_array_equal(other.origin, one.origin)
    assert len(set.union(*users.values())) == 5
    assert all(len(threads) == 1 for threads in users.values())


def test_wider_margins_keep_farther_off(robot_filter, scenes):
    observation, action, hazards = scenes(200, seed=5)
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


def test_look_is_what_filter_sees(robot_filter, scenes):
    observation, action, hazards = scenes(100, seed=6)
    for source in (hazards, None):
        view = robot_filter.look(observation, source)
        decided = robot_filter.filter(observation, action, source)
        assert len(view) == 100
        np.testing.assert_array_equal(view.barrier, decided.barrier)
        again = robot_filter.decide(view, action, np.zeros(100, MEMORY), np.ones(100, bool))
        np.testing.assert_array_equal(again.action, decided.action)
        # Below the floor some action may cost more than there is: that is where the barrier is below 0 too.
        assert view.low[view.barrier < 0.0].all()
        assert 5 < (~view.low).sum() < 95


def test_what_is_passed_in_is_not_changed(robot_filter, scenes):
    observation, action, hazards = scenes(50, seed=7)
    memory = robot_filter.filter(observation, action, hazards).memory
    before = [part.tobytes() for part in (observation, action, hazards, memory)]
    robot_filter.filter(observation, action, hazards, memory)
    assert [part.tobytes() for part in (observation, action, hazards, memory)] == before


def test_an_empty_list_overrules_no_sensor_and_a_list_that_lacks_one_neither(robot_filter, hand):
    hazards = np.array([[0.4, 0.0], [0.0, 0.9]])
    observation = hand.observe(hazards, (1.2, 0.0))[None]
    nominal = np.array([[1.0, 0.0]])
    for known in (None, np.empty((1, 0, 2)), hazards[None, 1:], np.full((1, 3, 2), np.nan)):
        decided = robot_filter.filter(observation, nominal, known)
        assert decided.mode[0] != Mode.NOMINAL
        # The bin straight ahead, behind the given ones.
        assert decided.hazard[0] == (0 if known is None else known.shape[1])
    # Given ones count though the lidar is blank.
    blank = hand.observe(np.empty((0, 2)), (1.2, 0.0))[None]
    assert robot_filter.filter(blank, nominal, hazards[None]).hazard[0] == 0
    assert robot_filter.filter(blank, nominal).mode[0] == Mode.NOMINAL


def test_half_a_hazard_is_refused(robot_filter):
    with pytest.raises(FilterInputError, match="NaN in both"):
        robot_filter.filter(np.zeros((1, 60)), np.zeros((1, 2)), np.array([[[np.nan, 0.0]]]))
