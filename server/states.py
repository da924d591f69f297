"""Where the service stands: six states, and the table of all transitions between them.

The table is the only place that says what may follow what; whoever shows a state, the health checks, the
metrics, the page, the documentation, takes its name from here.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple


class State(StrEnum):
    """Where the service stands."""

    STARTING = "starting"
    """It loads and warms up, and does not listen yet."""
    READY = "ready"
    """All is well."""
    DEGRADED = "degraded"
    """It decides, with faults of its own or an alarm that says so: /readyz says 503."""
    HOLD = "hold"
    """Every decision is the safe one: the plan goes on, then the robot coasts. Latched."""
    DRAINING = "draining"
    """It is about to stop: /readyz says 503, requests are still answered."""
    STOPPED = "stopped"
    """It answers nobody."""


class Cause(StrEnum):
    """What makes the service pass from one state to another."""

    LOADED = "loaded"
    """The bundle is checked and warmed up."""
    TROUBLE = "trouble"
    """An alarm with the effect `degrade` is active."""
    WELL = "well"
    """No such alarm is active any more."""
    HOLD = "hold"
    """`POST /hold`."""
    ALARM = "alarm"
    """An alarm with the effect `hold` is active."""
    RESUME = "resume"
    """`POST /resume`."""
    STOP = "stop"
    """SIGTERM or SIGINT."""
    END = "end"
    """What was in flight is answered, or a second signal came."""


SERVICE, OPERATOR, SYSTEM = "the service", "an operator with the admin key", "whoever may send signals"


class Transition(NamedTuple):
    """A row of the table."""

    source: State
    cause: Cause
    target: State
    by: str
    """Who causes it."""
    back: str
    """Who may undo it, or why nobody can."""


_NEVER = "nobody: it is started anew"

TABLE: tuple[Transition, ...] = (
    Transition(State.STARTING, Cause.LOADED, State.READY, SERVICE, _NEVER),
    Transition(State.STARTING, Cause.STOP, State.STOPPED, SYSTEM, _NEVER),
    Transition(State.READY, Cause.TROUBLE, State.DEGRADED, SERVICE, f"{SERVICE}, by itself"),
    Transition(State.DEGRADED, Cause.WELL, State.READY, SERVICE, f"{SERVICE}, by itself"),
    Transition(State.READY, Cause.HOLD, State.HOLD, OPERATOR, OPERATOR),
    Transition(State.DEGRADED, Cause.HOLD, State.HOLD, OPERATOR, OPERATOR),
    Transition(State.READY, Cause.ALARM, State.HOLD, SERVICE, OPERATOR),
    Transition(State.DEGRADED, Cause.ALARM, State.HOLD, SERVICE, OPERATOR),
    Transition(State.HOLD, Cause.RESUME, State.READY, OPERATOR, OPERATOR),
    Transition(State.READY, Cause.STOP, State.DRAINING, SYSTEM, _NEVER),
    Transition(State.DEGRADED, Cause.STOP, State.DRAINING, SYSTEM, _NEVER),
    Transition(State.HOLD, Cause.STOP, State.DRAINING, SYSTEM, _NEVER),
    # Who drains still answers: a hold holds, and nobody can lift it any more.
    Transition(State.DRAINING, Cause.HOLD, State.DRAINING, OPERATOR, _NEVER),
    Transition(State.DRAINING, Cause.ALARM, State.DRAINING, SERVICE, _NEVER),
    Transition(State.DRAINING, Cause.END, State.STOPPED, SERVICE, _NEVER),
)
"""Every transition there is; whatever is not here is refused."""

_NEXT = {(row.source, row.cause): row for row in TABLE}
NOT_READY = frozenset({State.STARTING, State.DEGRADED, State.DRAINING, State.STOPPED})
"""Where /readyz says 503. Not in a hold: a balancer would take its robots to a service that does not hold."""


class TransitionError(ValueError):
    """A transition that is not in the table."""


class States:
    """Walks the table.

    Args:
        told: called after every transition with its row and why.

    Attributes:
        state: where it stands.
        why: why it stands there, in words.
        held: whether every decision is the safe one, and why; None: no. In `hold` it always is one.
    """

    def __init__(self, told: Callable[[Transition, str], None] | None = None) -> None:
        self.state = State.STARTING
        self.why = "it was started"
        self.held: str | None = None
        self._told = told

    def allows(self, cause: Cause) -> bool:
        """Whether something can happen here."""
        return (self.state, cause) in _NEXT

    def move(self, cause: Cause, why: str) -> State:
        """Passes to the next state.

        Args:
            cause: what happens.
            why: why, in words.

        Raises:
            TransitionError: if the table has no such row; nothing is changed then.
        """
        row = _NEXT.get((self.state, cause))
        if row is None:
            raise TransitionError(f"{cause} is not possible while the service is {self.state}")
        self.state, self.why = row.target, why
        if cause in (Cause.HOLD, Cause.ALARM):
            self.held = why
        elif cause is Cause.RESUME:
            self.held = None
        if self._told is not None:
            self._told(row, why)
        return self.state


def table() -> str:
    """The table in Markdown, as the documentation has it."""
    rows = [f"| {row.source} | {row.cause} | {row.target} | {row.by} | {row.back} |" for row in TABLE]
    return "\n".join(["| from | cause | to | by | who may undo it |", "|---|---|---|---|---|", *rows])
