"""What an operator sees and says: the state, the alarms, the counters, and the hold."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from monitor import Monitor
from recorder import Recorder
from server.alarms import RULES, Alarm, Alarms, Rule, Standing, Value
from server.duty import HELD, Duty
from server.events import Events
from server.schema import ModelReply
from server.states import Cause, State, States, Transition
from server.tally import Tally

WINDOW_SECONDS = 10.0
"""Over how long the alarms look at the decisions [s]."""


class _Mark(NamedTuple):
    """The tally at one time."""

    at: float
    decisions: int
    risky: int
    novel: int
    fallbacks: int
    opened: int
    requests: list[int]


class Operation:
    """What an operator sees of the service, and may say to it.

    All but `alarms.raise_` is to be called from one thread.

    Args:
        monitor: who decides first; it is loaded and warmed up.
        recorder: what records, if anything does.
        rules: the alarms' settings.
        events: what is told of what happens.

    Attributes:
        duty: who decides now.
        tally: what was answered; an observer.
        alarms: those that `tick` looks at.
        states: where the service stands.
        recorder: as given.
        events: as given.
    """

    def __init__(
        self,
        monitor: Monitor,
        recorder: Recorder | None = None,
        rules: Mapping[str, Rule] = RULES,
        events: Events | None = None,
    ) -> None:
        self.duty = Duty(monitor)
        self.tally = Tally(self.duty)
        self.recorder = recorder
        self.events = events or Events()
        self.states = States(self._moved)
        self.alarms = Alarms(rules, time.monotonic(), self._alarmed)
        self._unwell: dict[str, None] = {}
        self._marks: deque[_Mark] = deque([self._mark(time.monotonic())])
        self.states.move(Cause.LOADED, f"{monitor.bundle.id} is loaded")

    @property
    def gate_share(self) -> float | None:
        """The share of the last decisions in which the gate was open; None without any."""
        first, last = self._marks[0], self._marks[-1]
        return (last.opened - first.opened) / n if (n := last.decisions - first.decisions) else None

    def tick(self, now: float | None = None) -> State:
        """Looks at the alarms, and passes to the state that they ask for; to be called a few times a second.

        Args:
            now: the time [s]; None: that of `time.monotonic`.
        """
        now = time.monotonic() if now is None else now
        while len(self._marks) > 1 and now - self._marks[1].at >= WINDOW_SECONDS:
            self._marks.popleft()
        self._marks.append(self._mark(now))
        self.alarms.look(self._values(), now)
        states = self.states
        if (names := self.alarms.active("hold")) and states.held is None and states.allows(Cause.ALARM):
            self._hold(Cause.ALARM, f"alarm {', '.join(names)}")
        names = self.alarms.active("degrade")
        if states.allows(cause := Cause.TROUBLE if names else Cause.WELL):
            states.move(cause, f"alarm {', '.join(names)}" if names else "no alarm says otherwise")
        return states.state

    def unwell(self, robots: Iterable[str]) -> None:
        """Sets the alarm `staleness` for these robots, and for no other one."""
        now = dict.fromkeys(robots)
        for robot in self._unwell.keys() - now.keys():
            self.alarms.lower("staleness", robot)
        for robot in now:
            self.alarms.raise_("staleness", robot)
        self._unwell = now

    def hold(self, why: str) -> None:
        """From now on every decision is the safe one.

        Args:
            why: why, in words.

        Raises:
            TransitionError: if the service has stopped, or has not started.
        """
        if self.states.state is not State.HOLD:  # where it is held already, all is as it was asked for
            self._hold(Cause.HOLD, why)

    def resume(self) -> None:
        """The monitor decides again.

        Raises:
            TransitionError: if the service is not held.
            HeldError: if an alarm that holds it is still active.
        """
        if names := self.alarms.active("hold"):
            raise HeldError(f"alarm {', '.join(names)} is active, and holds the service")
        self.states.move(Cause.RESUME, "an operator said so")
        self.duty.hold(None)

    def acknowledge(self, name: str) -> None:
        """Somebody has seen an alarm.

        Raises:
            KeyError: if there is none of that name.
        """
        self.alarms.acknowledge(name, time.monotonic())
        self.events.tell("acknowledged", alarm=name)

    def take_over(self, monitor: Monitor) -> ModelReply:
        """Another monitor decides from now on; what it tells of itself."""
        before = self.duty.now.model.model
        self.duty.take_over(monitor, self.states.held)
        model = self.duty.now.model
        self.events.tell("bundle", before=before, model=model.model)
        return model

    def drain(self) -> None:
        """The service is about to stop."""
        if self.states.allows(Cause.STOP):
            self.states.move(Cause.STOP, "it was told to stop")

    def stop(self) -> None:
        """The service has stopped."""
        self.drain()
        self.states.move(Cause.END, "what was in flight is answered")

    def snapshot(self) -> dict[str, Any]:
        """All of it as plain JSON: state, why, alarms, counters, model."""
        return {
            "state": str(self.states.state),
            "why": self.states.why,
            "alarms": self.alarms.to_json(time.monotonic(), time.time()),
            "counters": self.tally.counters(),
            "model": self.duty.now.model.model,
        }

    def _hold(self, cause: Cause, why: str) -> None:
        self.states.move(cause, why)
        self.duty.hold(why)

    def _moved(self, row: Transition, why: str) -> None:
        level = "warning" if row.target in (State.DEGRADED, State.HOLD) else "info"
        self.events.tell("state", level, state=row.target, before=row.source, cause=row.cause, why=why)

    def _alarmed(self, name: str, alarm: Alarm) -> None:
        """An alarm was set, latched or cleared."""
        set_ = alarm.standing is Standing.ACTIVE
        chattering = {"chattering": True} if alarm.chatters(time.monotonic()) else {}
        told = {"value": alarm.value, "limit": alarm.rule.limit, "cause": alarm.cause} | chattering
        self.events.tell("alarm", "warning" if set_ else "info", alarm=name, state=alarm.standing, **told)
        # What no longer records, or hardly does, is not asked to.
        if set_ and name != "recorder" and self.recorder is not None:
            self.recorder.incident(f"alarm {name}: {alarm.cause}")

    def _mark(self, now: float) -> _Mark:
        tally = self.tally
        decisions = tally.decisions
        fallbacks = sum(tally.fallbacks.values()) - tally.fallbacks[HELD]
        opened = decisions - tally.opened[None]
        requests = tally.seconds["request"].counts
        return _Mark(now, decisions, tally.risky, tally.novel, fallbacks, opened, list(requests))

    def _values(self) -> dict[str, Value]:
        """What the alarms are compared with; those that are raised by name are not here."""
        first, last = self._marks[0], self._marks[-1]
        decisions = last.decisions - first.decisions

        def share(name: str, what: str) -> Value:
            count = getattr(last, name) - getattr(first, name)
            return count / decisions if decisions else None, f"{count} of {decisions} decisions {what}"

        slow = self.tally.seconds["request"].quantile(0.99, first.requests)
        faults = self.duty.now.monitor.faults.internal()
        stopped = None if self.recorder is None else self.recorder.alarm
        return {
            "risk": share("risky", "had a risk score above the threshold"),
            "fallbacks": share("fallbacks", "were fallbacks"),
            "novelty": share("novel", "had a novelty above 1"),
            "latency": (
                slow,
                f"1 in 100 requests took more than {self.alarms.alarms['latency'].rule.limit} s",
            ),
            "faults": (float(faults), f"{faults} internal faults within a minute"),
            "recorder": (float(stopped is not None), stopped or ""),
        }


class HeldError(ValueError):
    """A hold that cannot be lifted yet."""
