"""How old an observation is, by clocks of every kind; robots that are late, held, silent, forgotten."""

from __future__ import annotations

import math

import pytest
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st

from decision import PLAN_STEPS
from server.app import create_app
from server.clock import DRIFT, LEARNING, LEARNING_STAMPS, Clock, ClockError
from server.freshness import MANY_LATE, Freshness, Limits, RobotState
from server.keys import Keys
from server.safety import Safety

STEP = 0.02
PLAN = [[0.05, -1.0], [0.03, 0.0]]


def learned(clock: Clock, epoch: float = 0.0, delay: float = 0.001, start: float = 1000.0) -> float:
    """Stamps until the clock is learned; the time after them."""
    steps = int(LEARNING / STEP) + LEARNING_STAMPS
    for k in range(steps):
        clock.age(start + k * STEP - epoch, start + k * STEP + delay)
    return start + steps * STEP


def read(clock: Clock, stamps: list[tuple[float, float]]) -> list[float]:
    return [clock.age(*pair) for pair in stamps]


@given(
    epoch=st.floats(-900.0, 900.0),
    rate=st.floats(-0.9 * DRIFT, 0.9 * DRIFT),
    delays=st.lists(st.floats(0.0, 0.2), min_size=30, max_size=200),
    least=st.floats(0.0, 0.05),
)
def test_an_age_is_what_the_delay_is_above_the_least_one(epoch, rate, delays, least) -> None:
    """Whatever the clock's epoch and its drift, within what the drift comes to over the time."""
    clock, jump = Clock(1.0), least
    slack = 2.0 * DRIFT * (STEP * len(delays) + 0.2) + 1e-9
    smallest, last = math.inf, -math.inf
    for k, delay in enumerate(delays):
        made = 1000.0 + k * STEP
        # Requests of one robot come in order.
        now = last = max(last, made + jump + delay)
        smallest = min(smallest, now - made)
        age = clock.age((made - epoch) * (1.0 + rate) if epoch <= made else made - epoch, now)
        drifted = abs(rate) * abs(made - epoch - (1000.0 - epoch))
        assert age >= 0.0
        assert abs(age - (now - made - smallest)) <= slack + drifted


@settings(deadline=None)
@given(hidden=st.floats(0.02, 1.0), growth=st.floats(2.0 * DRIFT, 1.0))
def test_a_network_that_becomes_slow_is_noticed_however_slowly(hidden, growth) -> None:
    """A delay that grows faster than a clock may drift comes to any age; it is not forgotten as it grows."""
    clock = Clock(0.1)
    start = learned(clock)
    k, delay, age = 0, 0.0, 0.0
    while delay < hidden:
        delay = min(growth * k * STEP, hidden)
        now = start + k * STEP + delay
        age = clock.age(start + k * STEP, now + 0.001)
        k += 1
    assert age >= 0.45 * hidden - 1e-6


@given(back=st.floats(1e-6, 1e6), steps=st.integers(0, 100))
def test_a_stamp_that_goes_back_is_a_fault_and_teaches_nothing(back, steps) -> None:
    clock = Clock(0.1)
    for k in range(steps + 1):
        clock.age(2e6 + k * STEP, 5.0 + k * STEP)
    last = 2e6 + steps * STEP
    with pytest.raises(ClockError, match="goes back"):
        clock.age(last - back, 5.0 + steps * STEP + STEP)
    assert clock.age(last, 5.0 + steps * STEP + STEP) == pytest.approx(STEP, abs=1e-4)


@given(ahead=st.floats(0.11, 1e6))
def test_a_clock_that_jumps_ahead_is_a_fault_as_long_as_it_does(ahead) -> None:
    clock = Clock(0.1)
    start = learned(clock)
    for k in range(100):
        with pytest.raises(ClockError, match="ahead"):
            clock.age(start + k * STEP + ahead + 0.1, start + k * STEP)
    assert clock.age(start + 2.0, start + 2.001) < 0.01


@given(jump=st.floats(0.01, 0.09))
def test_many_small_jumps_are_one_large_one(jump) -> None:
    clock = Clock(0.1)
    start = learned(clock)
    stamps = [(start + k * (STEP + jump), start + k * STEP) for k in range(int(0.1 / jump) + 3)]
    with pytest.raises(ClockError, match="ahead"):
        read(clock, stamps)


@pytest.mark.parametrize("rate", [0.002, 0.01, 0.5])
def test_a_clock_that_drifts_too_fast_is_a_fault(rate) -> None:
    """Ahead of ours it is told as such; behind ours, its observations become old."""
    clock = Clock(0.1)
    start = learned(clock)
    with pytest.raises(ClockError, match="ahead"):
        read(clock, [(start + k * STEP * (1.0 + rate), start + k * STEP) for k in range(20_000)])
    clock = Clock(0.1)
    start = learned(clock)
    assert (
        max(read(clock, [(start + k * STEP * (1.0 - rate), start + k * STEP) for k in range(10_000)])) > 0.1
    )


def test_a_clock_that_drifts_as_clocks_do_is_none() -> None:
    for rate in (-1e-4, 1e-4, -4e-4, 4e-4):
        clock = Clock(0.05)
        ages = [clock.age(k * STEP * (1.0 + rate), k * STEP) for k in range(200_000)]
        assert max(ages) < 0.01


def test_after_an_hour_of_silence_the_clock_is_still_known() -> None:
    clock = Clock(0.1)
    start = learned(clock) + 3600.0
    assert clock.age(start, start + 0.001) < 1e-3
    assert clock.age(start + STEP, start + STEP + 0.2) > 0.19


def notes() -> tuple[list[str], Limits]:
    return [], Limits(max_age=0.1, hold_after=0.5, silent_after=1.0, robots=3)


def test_a_stale_robot_is_held_and_only_a_reset_frees_it() -> None:
    kinds, limits = notes()
    known = Freshness(limits, lambda kind, _: kinds.append(kind))
    for k in range(100):
        assert known.see("a", k * STEP, k * STEP) is None
    told = [known.see("a", 2.0, 2.2 + k * STEP) for k in range(60)]
    assert all(unfit is not None for unfit in told)
    # First stale; once that lasts, held.
    assert {unfit.kind for unfit in told[:25]} == {"stale observation"}
    assert {unfit.kind for unfit in told[26:]} == {"hold"}
    assert [unfit.over for unfit in told] == [k >= PLAN_STEPS for k in range(60)]
    assert known.robots(3.4)[0].state == RobotState.HELD
    # A fresh one does not free it.
    assert known.see("a", 3.5, 3.5).kind == "hold"
    assert known.see("b", 7.0, 3.5) is None
    assert known.late("a", 3.5) == 61
    assert known.reset("a")
    assert not known.reset("nobody")
    assert known.see("a", 0.0, 3.52) is None
    assert known.robots(3.52)[1].state == RobotState.FRESH
    assert {"stale observation", "hold", "late robot", "reset"} == set(kinds)
    assert kinds.count("late robot") == 1


def test_a_fresh_one_in_between_keeps_it_from_being_held() -> None:
    known = Freshness(Limits(max_age=0.1, hold_after=0.5))
    for k in range(200):
        late = 0.3 if k % 4 else 0.0
        unfit = known.see("a", k * 0.1, k * 0.1 + late)
        assert (unfit is not None) == bool(late), k
        assert unfit is None or unfit.kind == "stale observation"


def test_a_clock_that_jumps_ends_in_a_hold() -> None:
    known = Freshness(Limits(max_age=0.1, hold_after=0.5))
    for k in range(100):
        assert known.see("a", k * STEP, k * STEP) is None
    told = [known.see("a", 100.0 + k * STEP, 2.0 + k * STEP).kind for k in range(50)]
    assert (told[0], told[-1]) == ("clock", "hold")


def test_who_does_not_say_how_old_it_is_gets_the_fallback_where_that_is_asked_for() -> None:
    strict, lax = Freshness(Limits(max_age=0.1)), Freshness()
    assert strict.see("a", None, 1.0).kind == "no stamp"
    assert strict.see(None, 1.0, 1.0).kind == "no stamp"
    assert strict.see(None, None, 1.0).kind == "no stamp"
    assert lax.see("a", None, 1.0) is None
    assert lax.see(None, None, 1.0) is None
    # A stamp is never ignored.
    assert lax.see(None, 1.0, 1.0).kind == "no stamp"
    assert lax.see("b", 5.0, 1.0) is None
    assert lax.see("b", 4.0, 1.1).kind == "clock"


@given(names=st.lists(st.sampled_from("abcdef"), max_size=40))
def test_as_many_are_known_as_may_be_and_who_is_held_is_not_forgotten(names) -> None:
    known = Freshness(Limits(max_age=0.1, hold_after=0.0, robots=3))
    assert known.see("held", None, 0.0).kind == "hold"
    for k, name in enumerate(names):
        assert known.see(name, 1.0 + k, 1.0 + k) is None
        told = {each.robot: each.state for each in known.robots(1.0 + k)}
        assert len(told) <= 3
        assert told[name] == RobotState.FRESH
        assert told["held"] == RobotState.HELD


def test_where_all_are_held_no_further_one_is_decided_about() -> None:
    known = Freshness(Limits(max_age=0.1, hold_after=0.0, robots=2))
    for name in "ab":
        known.see(name, None, 0.0)
    assert known.see("c", 1.0, 1.0).kind == "robots"
    known.reset("a")
    assert known.see("c", 1.0, 1.0) is None


def test_late_and_missing_requests_are_counted_and_silence_is_noted() -> None:
    kinds, limits = notes()
    known = Freshness(limits, lambda kind, _: kinds.append(kind))
    for k in range(50):
        known.see("a", k * STEP, k * STEP)
    assert known.late("a", 0.98) == 0
    assert known.late("a", 0.98 + 10.5 * STEP) == 10
    for k in range(50, 50 + MANY_LATE):
        known.see("a", k * STEP, k * STEP)
        known.missed("a")
    assert known.late("a", 1.08) == MANY_LATE
    assert kinds == ["late robot"]
    known.see("a", 1.1, 1.1)
    assert known.late("a", 1.1) == known.late("nobody", 1.1) == 0
    assert known.sweep(2.0) == []
    assert known.sweep(2.2) == ["a"]
    assert known.sweep(2.3) == []
    assert known.robots(2.3)[0].state == RobotState.SILENT
    assert kinds == ["late robot", "silent robot"]
    known.see("a", 2.4, 2.4)
    assert known.robots(2.4)[0].state == RobotState.FRESH
    assert known.sweep(9.0) == ["a"]


@pytest.fixture
def strict(monitor, memory_key) -> TestClient:
    """The service, with keys and a limit of 100 ms, which holds at once."""
    limits = Limits(max_age=0.1, hold_after=1e-6)
    keys = Keys(act="act", admin="admin")
    return TestClient(create_app(monitor, keys=keys, safety=Safety(freshness=limits), memory_key=memory_key))


ACT, ADMIN = ({"x-api-key": key} for key in ("act", "admin"))


def test_the_plan_goes_on_then_the_robot_stops_and_an_operator_frees_it(
    strict, monitor, observation, sealed
) -> None:
    before = monitor.faults.counts.copy()
    body = {"observation": observation, "robot": "r2", "stamp": 50.0}
    assert strict.post("/act", json=body, headers=ACT).json()["reason"] is None
    old = body | {"stamp": 49.0, "memory": sealed(PLAN, "r2")}
    for action in (*PLAN, [0.0, 0.0]):
        content = strict.post("/act", json=old, headers=ACT).json()
        assert (content["mode"], content["origin"], content["action"]) == ("fallback", "plan", action)
        assert "goes back by 1 s" in content["reason"]
        old["memory"] = content["memory"]
    # Whoever sends the same memory again and again does not drive on by it.
    old["memory"] = sealed(PLAN, "r2")
    actions = [strict.post("/act", json=old, headers=ACT).json()["action"] for _ in range(PLAN_STEPS + 1)]
    assert actions[0] == PLAN[0]
    assert actions[-1] == [0.0, 0.0]
    counts = monitor.faults.counts - before
    assert counts["hold"] > 20
    (told,) = strict.get("/robots", headers=ACT).json()["robots"]
    assert (told["robot"], told["state"]) == ("r2", "held")
    assert strict.post("/robots/r2/reset", headers=ACT).status_code == 403
    assert strict.post("/robots/r2/reset", headers=ADMIN).json() == {"robot": "r2", "state": "fresh"}
    assert strict.post("/robots/nobody/reset", headers=ADMIN).status_code == 404
    assert strict.post("/robots/no body/reset", headers=ADMIN).status_code == 422
    assert strict.post("/act", json=body | {"stamp": 2.0}, headers=ACT).json()["reason"] is None


def test_a_batch_decides_about_the_fresh_ones(strict, observation, sealed) -> None:
    body = {"observation": observation, "stamp": 50.0}
    robots = [
        body | {"robot": "r0"},
        {"observation": observation, "memory": sealed(PLAN)},
        body | {"robot": "r2"},
    ]
    first, second, third = strict.post("/act/batch", json={"robots": robots}, headers=ACT).json()["replies"]
    assert (second["mode"], second["action"]) == ("fallback", PLAN[0])
    assert "`robot` is missing" in second["reason"]
    for told in (first, third):
        assert told["reason"] is None
        assert told["action"] == first["action"]


@pytest.mark.parametrize("stamp", ["1", True, -1.0, 1e11, "NaN", "1e999"])
def test_a_stamp_that_is_none_is_refused_and_named(app, observation, stamp) -> None:
    text = (
        stamp
        if isinstance(stamp, str) and stamp != "1"
        else {True: "true", "1": '"1"'}.get(stamp, str(stamp))
    )
    content = f'{{"observation": {observation}, "robot": "a", "stamp": {text}}}'
    reply = app.post("/act", content=content)
    assert reply.status_code == 422
    assert reply.json()["detail"][0]["loc"] == ["body", "stamp"]


@given(
    asked=st.lists(st.tuples(st.sampled_from("abc"), st.floats(0.01, 0.5), st.booleans()), max_size=30),
    later=st.floats(0.0, 200.0),
)
def test_who_is_unwell_is_stale_held_or_missed(asked, later: float) -> None:
    freshness = Freshness(Limits(max_age=0.05, hold_after=0.3, silent_after=1.0))
    now = 10.0
    for robot, gap, old in asked:
        now += gap
        freshness.see(robot, now - (1.0 if old else 0.0), now)
    now += later
    unwell = set(freshness.unwell(now))
    for seen in freshness.robots(now):
        if seen.state is RobotState.HELD:
            assert seen.robot in unwell
        elif seen.ago >= 60.0:
            # It has left.
            assert seen.robot not in unwell
        else:
            late = seen.late >= MANY_LATE
            well = seen.state is RobotState.FRESH and not late
            assert (seen.robot not in unwell) is (well and seen.reason is None)
