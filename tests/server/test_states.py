"""The service's states: every row of the table is walked, and nothing else is possible."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from decision import Faults
from monitor import Monitor
from server.alarms import RULES, Effect, Standing
from server.duty import Held
from server.operation import HeldError, Operation
from server.states import NOT_READY, TABLE, Cause, State, States, TransitionError, table

HOLDING = RULES | {
    "staleness": RULES["staleness"].model_copy(update={"effect": "hold", "off_delay": 0.0, "latch": False}),
    "faults": RULES["faults"].model_copy(update={"limit": 0.0}),
}
"""A robot that is silent holds the service; one fault degrades it."""

WAYS: dict[State, list[Cause]] = {
    State.STARTING: [],
    State.READY: [Cause.LOADED],
    State.DEGRADED: [Cause.LOADED, Cause.TROUBLE],
    State.HOLD: [Cause.LOADED, Cause.HOLD],
    State.DRAINING: [Cause.LOADED, Cause.STOP],
    State.STOPPED: [Cause.STOP],
}
"""How each state is come to."""


def come_to(state: State) -> States:
    states = States()
    for cause in WAYS[state]:
        states.move(cause, "a test")
    assert states.state is state
    return states


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"{row.source}, {row.cause}")
def test_every_row_is_walked(row) -> None:
    told = []
    states = come_to(row.source)
    states._told = lambda *moved: told.append(moved)
    assert states.allows(row.cause)
    assert states.move(row.cause, "why") is row.target
    assert (states.state, states.why) == (row.target, "why")
    assert told == [(row, "why")]
    if row.cause in (Cause.HOLD, Cause.ALARM):
        assert states.held == "why"
    if row.target is State.HOLD:
        assert states.held is not None


@given(st.sampled_from(State), st.sampled_from(Cause))
def test_what_is_not_in_the_table_is_refused_and_changes_nothing(state: State, cause: Cause) -> None:
    states = come_to(state)
    before = dict(vars(states))
    if any((row.source, row.cause) == (state, cause) for row in TABLE):
        assert states.allows(cause)
        return
    assert not states.allows(cause)
    with pytest.raises(TransitionError, match=f"{cause} is not possible while the service is {state}"):
        states.move(cause, "why")
    assert vars(states) == before


def test_the_table_is_whole() -> None:
    """One row a state and cause; every state can be come to and, but for the last, left."""
    assert len({(row.source, row.cause) for row in TABLE}) == len(TABLE)
    assert {row.target for row in TABLE} | {State.STARTING} == set(State)
    assert {row.source for row in TABLE} == set(State) - {State.STOPPED}
    assert {row.cause for row in TABLE} == set(Cause)
    for state in set(State) - {State.DRAINING, State.STOPPED}:
        assert come_to(state).allows(Cause.STOP)
    # Nothing but an operator's word ends a hold.
    assert {row.cause for row in TABLE if row.source is State.HOLD} == {Cause.RESUME, Cause.STOP}


def test_the_documentation_has_the_table() -> None:
    assert table() in (Path(__file__).parents[2] / "docs" / "service.md").read_text()


class Walk(RuleBasedStateMachine):
    """An operation from its start to its end, with a model of what it should be beside it."""

    monitor: Monitor
    walked: set[tuple[State, Cause]]

    def __init__(self) -> None:
        super().__init__()
        self.monitor.faults = Faults("lagnet.nobody")
        self.operation = Operation(self.monitor, rules=HOLDING)
        self.walked.add((State.STARTING, Cause.LOADED))
        moved = self.operation.states._told

        def told(row, why: str) -> None:
            self.walked.add((row.source, row.cause))
            moved(row, why)

        self.operation.states._told = told
        self.now = self.operation._marks[-1].at
        self.held = self.silent = self.stopped = False
        self.ticks = 0

    def tick(self) -> None:
        self.now += 0.2
        self.ticks += 1
        self.operation.tick(self.now)
        if self.silent:
            self.held = True

    @property
    def over(self) -> bool:
        return self.operation.states.state is State.STOPPED

    @rule()
    def nothing_happens(self) -> None:
        if not self.over:
            self.tick()

    @rule(silent=st.booleans())
    def a_robot_falls_silent_or_is_back(self, silent: bool) -> None:
        if not self.over:
            (self.operation.alarms.raise_ if silent else self.operation.alarms.lower)("staleness", "one")
            self.silent = silent
            self.tick()

    @rule(broken=st.booleans())
    def something_fails_or_is_forgotten(self, broken: bool) -> None:
        if self.over:
            return
        if broken:
            self.monitor.faults.note("a fault", "a test", ValueError("a test"))
        else:
            self.monitor.faults = Faults("lagnet.nobody")
        self.tick()

    @rule()
    def hold(self) -> None:
        if self.over:
            with pytest.raises(TransitionError):
                self.operation.hold("a test")
        else:
            self.operation.hold("a test")
            self.held = True

    @rule()
    def resume(self) -> None:
        possible = self.operation.states.state is State.HOLD and not self.operation.alarms.active("hold")
        if possible:
            self.operation.resume()
            self.held = False
        else:
            with pytest.raises((TransitionError, HeldError)):
                self.operation.resume()

    # Most walks are to see something before they end.
    @precondition(lambda self: self.ticks > 5)
    @rule()
    def drain(self) -> None:
        self.operation.drain()
        self.stopped = True

    @precondition(lambda self: self.ticks > 5)
    @rule()
    def stop(self) -> None:
        if not self.over:
            self.operation.stop()
            self.stopped = True

    @invariant()
    def a_hold_holds(self) -> None:
        """Whatever else happens, every decision is the safe one from the hold on until it is lifted."""
        states = self.operation.states
        assert (states.held is not None) == self.held
        assert isinstance(self.operation.duty.now.decider, Held) == self.held
        assert (states.state in (State.DRAINING, State.STOPPED)) == self.stopped
        if states.state is State.HOLD:
            assert self.held
        if self.held and not self.stopped:
            assert states.state is State.HOLD

    @invariant()
    def it_is_what_it_says(self) -> None:
        told = self.operation.snapshot()
        assert told["state"] == self.operation.states.state
        assert all(alarm["state"] in set(Standing) for alarm in told["alarms"])
        if self.operation.states.state is State.DEGRADED:
            assert State.DEGRADED in NOT_READY


def test_an_operation_walks_the_table(monitor: Monitor) -> None:
    walked: set[tuple[State, Cause]] = set()
    # The session's monitor with faults of its own.
    mine = Monitor.__new__(Monitor)
    mine.__dict__ |= monitor.__dict__
    machine = type("Walk", (Walk,), {"monitor": mine, "walked": walked})
    run_state_machine_as_test(
        machine,
        settings=settings(max_examples=150, stateful_step_count=30, deadline=None, derandomize=True),
    )
    # Rows that take several steps in the right order, which the draw seldom has.
    for start in ("something_fails_or_is_forgotten", "drain"):
        walk = machine()
        getattr(walk, start)(*([True] if start != "drain" else []))
        walk.a_robot_falls_silent_or_is_back(True)
        walk.a_hold_holds()
    # Before it is loaded there is no operation to be stopped.
    missing = {(row.source, row.cause) for row in TABLE} - walked
    assert missing == {(State.STARTING, Cause.STOP)}


@pytest.mark.parametrize("effect", ["tell", "degrade", "hold"])
def test_an_alarm_has_the_effect_that_it_was_given(monitor: Monitor, effect: Effect) -> None:
    rules = RULES | {"staleness": RULES["staleness"].model_copy(update={"effect": effect})}
    operation = Operation(monitor, rules=rules)
    operation.alarms.raise_("staleness", "one")
    expected = {"tell": State.READY, "degrade": State.DEGRADED, "hold": State.HOLD}
    assert operation.tick() is expected[effect]
