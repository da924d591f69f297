"""Which robots the service knows, and whether what they see is fresh enough to be decided about."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from threading import Lock

from decision import PLAN_STEPS
from server.clock import Clock, ClockError

MANY_LATE = 5
"""Late or missing requests in a row from which on they are noted."""
_JUMP = 0.5
"""By how much a clock may jump where no age is asked for [s]."""
_GONE = 60.0
"""A robot that was silent for so long has left, and is no longer missed [s]."""
_USUAL = 0.1
"""Weight of the newest gap between two requests in the usual one."""


class RobotState(StrEnum):
    """Where a robot stands."""

    FRESH = "fresh"
    """Its last observation was decided about."""
    STALE = "stale"
    """Its last observation was too old, or nobody knows how old: it got the fallback."""
    HELD = "held"
    """It was stale for too long: it gets the fallback until it is reset."""
    SILENT = "silent"
    """It has not asked for a while."""


@dataclass(frozen=True)
class Limits:
    """What is still fresh.

    Attributes:
        max_age: how old an observation may be [s]; None: only its clock is checked, where it is stamped.
        hold_after: for how long a robot may go without a fresh one before it is held [s].
        silent_after: how long a robot may not ask before it counts as silent [s].
        robots: how many robots are remembered.
        alone: whether one process answers every request of a robot. Otherwise none can follow its clock or
            hold it, and what is stamped is not decided about.
    """

    max_age: float | None = None
    hold_after: float = 1.0
    silent_after: float = 1.0
    robots: int = 1024
    alone: bool = True


@dataclass(frozen=True, slots=True)
class Unfit:
    """An observation that is not to be decided about.

    Attributes:
        kind: what is counted: "stale observation", "clock", "hold", "no stamp".
        reason: why.
        over: whether the robot has had so many fallbacks in a row that no plan goes on.
    """

    kind: str
    reason: str
    over: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """What is known of one robot, as `GET /robots` tells it.

    Attributes:
        robot: its name.
        state: fresh, stale, held, silent.
        reason: why it is stale or held, else null.
        age: how old its last observation was when it came [s]; null: that cannot be told.
        ago: when it last asked [s].
        requests: how often it has asked.
        late: how many of its requests in a row were late or are missing.
    """

    robot: str
    state: RobotState
    reason: str | None
    age: float | None
    ago: float
    requests: int
    late: int


@dataclass(eq=False, slots=True)
class _Robot:
    clock: Clock
    seen: float
    requests: int = 0
    gap: float = math.nan
    age: float | None = None
    reason: str | None = None
    unfit: int = 0
    unfit_since: float = math.nan
    held: str | None = None
    late: int = 0
    late_at: int = -1
    silent: bool = False

    def asked(self, now: float) -> None:
        """It has asked."""
        if self.requests:
            gap = max(now - self.seen, 0.0)
            self.gap = gap if math.isnan(self.gap) else self.gap + _USUAL * (gap - self.gap)
        self.seen, self.silent = now, False
        self.requests += 1

    def in_a_row(self, now: float) -> int:
        """How many requests in a row were late or are missing."""
        late = self.late if self.late_at == self.requests else 0
        return late + (int((now - self.seen) / self.gap) if self.gap > 0.0 else 0)

    def missed(self) -> int:
        """Its last request was late; how many in a row were."""
        if self.late_at != self.requests:
            self.late = self.late + 1 if self.late_at == self.requests - 1 else 1
            self.late_at = self.requests
        return self.late


@dataclass
class Freshness:
    """The robots that ask, by the names they give; as many as `Limits.robots`.

    Where there are more, whoever asked longest ago is forgotten; a robot that is held never is.

    Attributes:
        limits: what is still fresh.
        note: told the kind of what is worth a line in the log, and the line.
    """

    limits: Limits = field(default_factory=Limits)
    note: Callable[[str, str], None] = lambda kind, message: None
    _robots: OrderedDict[str, _Robot] = field(default_factory=OrderedDict, init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def see(self, robot: str | None, stamp: float | None, now: float) -> Unfit | None:
        """Whether an observation is to be decided about.

        Args:
            robot: who made it; None: it has no name.
            stamp: when, by the robot's clock [s]; None: nobody knows.
            now: when it came [s].

        Returns:
            Why not, or None.
        """
        if stamp is not None and not self.limits.alone:
            apart = Unfit("stamp", "several processes answer, and none of them can follow a robot's clock")
            self.note(apart.kind, apart.reason)
            return apart
        if robot is None:
            if self.limits.max_age is None and stamp is None:
                return None
            # Two robots without a name would be taken for one with a clock that jumps.
            nameless = Unfit("no stamp", "how old the observation is cannot be told: `robot` is missing")
            self.note(nameless.kind, nameless.reason)
            return nameless
        with self._lock:
            known = self._known(robot, now)
            unfit: Unfit | None
            if known is None:
                unfit = Unfit("robots", f"{self.limits.robots} robots are held: no further one is known")
            else:
                known.asked(now)
                unfit = self._judged(known, stamp, now)
                if unfit is None:
                    return None
                late = known.missed()
                if late == MANY_LATE:
                    self.note("late robot", f"{robot}: {late} requests in a row without a fresh observation")
        self.note(unfit.kind, f"{robot}: {unfit.reason}")
        return unfit

    def missed(self, robot: str | None) -> None:
        """A robot's request was not answered in time, whether it was seen or not."""
        with self._lock:
            known = None if robot is None else self._robots.get(robot)
            if known is None:
                return
            late = known.missed()
        if late == MANY_LATE:
            self.note("late robot", f"{robot}: {late} requests in a row were not answered in time")

    def late(self, robot: str, now: float) -> int:
        """How many requests of a robot in a row were late or are missing; 0 for one that is not known.

        Late is one that was stale, or whose decision took too long; missing, one that by the usual time
        between two should have come.
        """
        with self._lock:
            known = self._robots.get(robot)
            return 0 if known is None else known.in_a_row(now)

    def sweep(self, now: float) -> list[str]:
        """The robots that have fallen silent since the last sweep; each is noted."""
        if not self.limits.alone:
            return []  # they may ask another process
        with self._lock:
            fallen = [
                (name, known)
                for name, known in self._robots.items()
                if not known.silent and now - known.seen > self.limits.silent_after
            ]
            for _, known in fallen:
                known.silent = True
        for name, known in fallen:
            self.note("silent robot", f"{name}: silent for {now - known.seen:.1f} s")
        return [name for name, _ in fallen]

    def unwell(self, now: float) -> list[str]:
        """The robots that are stale, held, late again and again, or silent for less than a minute."""
        with self._lock:
            return [
                name
                for name, known in self._robots.items()
                if known.held is not None
                or (now - known.seen < _GONE and (known.reason is not None or self._is_late(known, now)))
            ]

    def reset(self, robot: str) -> bool:
        """Ends a robot's hold; its clock is learned anew. False if it is not known."""
        with self._lock:
            known = self._robots.get(robot)
            if known is None:
                return False
            known.held = known.reason = known.age = None
            known.unfit, known.unfit_since = 0, math.nan
            known.clock = self._clock()
        self.note("reset", f"{robot}: reset")
        return True

    def robots(self, now: float) -> list[Seen]:
        """The robots that are known, whoever asked last comes last."""
        with self._lock:
            return [
                Seen(
                    robot=name,
                    state=self._state(known, now),
                    reason=known.reason,
                    age=known.age,
                    ago=max(now - known.seen, 0.0),
                    requests=known.requests,
                    late=known.in_a_row(now),
                )
                for name, known in self._robots.items()
            ]

    def _is_late(self, known: _Robot, now: float) -> bool:
        return now - known.seen > self.limits.silent_after or known.in_a_row(now) >= MANY_LATE

    def _state(self, known: _Robot, now: float) -> RobotState:
        if known.held is not None:
            return RobotState.HELD
        if now - known.seen > self.limits.silent_after:
            return RobotState.SILENT
        return RobotState.FRESH if known.reason is None else RobotState.STALE

    def _judged(self, known: _Robot, stamp: float | None, now: float) -> Unfit | None:
        """Judges an observation, and what follows from it for its robot."""
        found = self._wrong(known, stamp, now)
        if found is None and known.held is None:
            known.reason, known.unfit, known.unfit_since = None, 0, math.nan
            return None
        kind, reason = found or ("hold", "")
        if math.isnan(known.unfit_since):
            known.unfit_since = now
        if known.held is None and now - known.unfit_since >= self.limits.hold_after:
            known.held = reason
        if known.held is not None:
            kind, reason = "hold", f"held until it is reset: {known.held}"
        known.reason = reason
        known.unfit += 1
        return Unfit(kind, reason, known.unfit > PLAN_STEPS)

    def _wrong(self, known: _Robot, stamp: float | None, now: float) -> tuple[str, str] | None:
        """What is wrong with a stamp."""
        most = self.limits.max_age
        if stamp is None:
            if most is None:
                return None
            return "no stamp", "how old the observation is cannot be told: `stamp` is missing"
        try:
            known.age = known.clock.age(stamp, now)
        except ClockError as error:
            return "clock", str(error)
        if most is None or known.age <= most:
            return None
        return "stale observation", f"the observation is {1e3 * known.age:.0f} ms old, or its clock too slow"

    def _known(self, robot: str, now: float) -> _Robot | None:
        """A robot, now the one that asked last; None if it is new and there is no place."""
        known = self._robots.get(robot)
        if known is not None:
            self._robots.move_to_end(robot)
            return known
        if len(self._robots) >= self.limits.robots:
            longest = next((name for name, each in self._robots.items() if each.held is None), None)
            if longest is None:
                return None
            del self._robots[longest]
        known = self._robots[robot] = _Robot(self._clock(), now)
        return known

    def _clock(self) -> Clock:
        return Clock(_JUMP if self.limits.max_age is None else self.limits.max_age)
