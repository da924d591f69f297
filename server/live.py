"""What the live page is told: what became of every robot, ten times a second, while somebody watches.

The decision path pays for a few assignments a decision. Everything else is done between decisions, in the
event loop's own thread and in slices of a fraction of a millisecond: a second thread would hold the
interpreter's lock for longer.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, Protocol

from decision import Decision, Faults, Mode
from server.observer import Answered
from server.schema import ActRequest
from server.view import Views

TICK = 0.1
"""Seconds between two updates."""
MOST_ROBOTS = 64
"""Robots that are shown; while so many are heard of, others are not."""
MOST_WATCHERS = 16
"""Streams at once."""
PATIENCE = 5.0
"""How long a watcher may leave an update unread [s]."""
_SILENT = 1.0
"""A robot that was silent for so long makes room for another [s]."""
_FORGOTTEN = 600.0
"""A robot that was silent for so long is no longer shown [s]."""
_NOMINAL = Mode.NOMINAL
_SEVERITY = {_NOMINAL: 0, Mode.GUIDED: 1, Mode.FILTERED: 2, Mode.FALLBACK: 3}

Name = str | tuple[Any, int]
"""A robot's own name, or the connection on which it asks and its place in the batch."""


class Operation(Protocol):
    """Tells where the service stands."""

    def snapshot(self) -> Mapping[str, Any]:
        """What the page shows of it, as plain JSON.

        Returns:
            state: starting, ready, degraded, hold, draining or stopped.
            why: why that, in words; may be left out.
            alarms: a list of name, state (clear, pending, active, latched), since [s since 1970], value,
                limit, acknowledged, cause.
            counters: name → number.
            model: the bundle's id.
        """


class Robot:
    """One robot: what it was told last, and what is worth knowing of all since the last update."""

    __slots__ = (
        "asked",
        "decision",
        "heard",
        "least",
        "peak",
        "rank",
        "seconds",
        "slowest",
        "steps",
        "worst",
    )

    asked: ActRequest
    decision: Decision
    worst: Decision
    """The last of those of the severest mode."""
    rank: int
    """How severe that is."""
    heard: float
    """When it was told, on the monotonic clock [s]."""
    seconds: float
    """How long that took [s]."""
    steps: int
    """How many decisions there were."""
    slowest: float
    """How long the slowest of them took [s]."""
    peak: float
    """The highest risk score; NaN if one was no number."""
    least: float
    """The lowest barrier [m]; NaN if one was unknown."""

    def __init__(self, asked: ActRequest, decision: Decision, seconds: float, heard: float) -> None:
        self.begin()
        self.note(asked, decision, seconds, heard)

    def begin(self) -> None:
        """An update begins."""
        self.steps, self.rank, self.slowest, self.peak, self.least = 0, -1, 0.0, -math.inf, math.inf

    def note(self, asked: ActRequest, decision: Decision, seconds: float, heard: float) -> None:
        """Takes note of a decision."""
        mode = decision.mode
        rank = 0 if mode is _NOMINAL else _SEVERITY[mode]
        if rank >= self.rank:
            self.rank, self.worst = rank, decision
        self.asked, self.decision, self.seconds, self.heard = asked, decision, seconds, heard
        self.steps += 1
        self.slowest = max(self.slowest, seconds)
        # A NaN is above and below everything, and stays.
        if not decision.risk <= self.peak and self.peak == self.peak:
            self.peak = decision.risk
        if not decision.barrier >= self.least and self.least == self.least:
            self.least = decision.barrier

    def told(self, now: float) -> dict[str, Any]:
        """All of it, as plain JSON; what is unknown is null."""
        last, worst = self.decision, self.worst
        quiet = self.steps == 0
        return {
            "age": round(now - self.heard, 3),
            "steps": self.steps,
            "mode": last.mode,
            "origin": last.origin,
            "opened_by": last.opened_by,
            "reason": last.reason,
            "suspect": last.suspect,
            "certified": last.certified,
            "risk": _finite(last.risk),
            "threshold": _finite(last.threshold),
            "barrier": _finite(last.barrier),
            "novelty": _finite(last.novelty),
            "seconds": self.seconds,
            "since": None
            if quiet
            else {
                "mode": worst.mode,
                "origin": worst.origin,
                "opened_by": worst.opened_by,
                "reason": worst.reason,
                "risk": _finite(self.peak),
                "barrier": _finite(self.least),
                "seconds": self.slowest,
            },
        }


class Watcher:
    """One stream: the update that was not taken yet.

    Args:
        robot: the name of the robot that is looked at; None: the first.
    """

    def __init__(self, robot: str | None) -> None:
        self.robot = robot
        self.closed = False
        self._update: str | None = None
        self._since = math.inf
        self._woken = asyncio.Event()

    def put(self, update: str, now: float) -> None:
        """Hands an update over; one that was not taken is lost."""
        if self._update is None:
            self._since = now
        self._update = update
        self._woken.set()

    def waits(self, now: float) -> float:
        """For how long no update has been taken [s]."""
        return 0.0 if self._update is None else now - self._since

    def close(self) -> None:
        """Ends the stream."""
        self.closed = True
        self._woken.set()

    async def take(self) -> str | None:
        """The next update; None: the stream has ended."""
        await self._woken.wait()
        self._woken.clear()
        update, self._update = self._update, None
        return None if self.closed else update


class Hub:
    """Observes the answers, and tells watchers.

    Args:
        views: draws up what the robot sees that is looked at.
        operation: tells where the service stands.
        about: what never changes while the service runs, as plain JSON: told first.
        clock: monotonic [s].
        patience: how long a watcher may leave an update unread [s].

    Attributes:
        faults: what went wrong with the streams so far.
    """

    def __init__(
        self,
        views: Views,
        operation: Operation,
        about: Mapping[str, Any],
        clock: Callable[[], float] = time.monotonic,
        patience: float = PATIENCE,
    ) -> None:
        self.faults = Faults("lagnet.live")
        self._views = views
        self._operation = operation
        self._about = json.dumps(dict(about), allow_nan=False)
        self._clock = clock
        self._patience = patience
        self._robots: dict[Name, Robot] = {}
        self._crowded = -math.inf
        self._watchers: set[Watcher] = set()
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def full(self) -> bool:
        """Whether there is no place for one more watcher."""
        return self._closed or len(self._watchers) >= MOST_WATCHERS

    @property
    def watchers(self) -> int:
        """How many watch."""
        return len(self._watchers)

    def answered(self, answered: Answered) -> None:
        """Takes note of the decisions of one request."""
        now = self._clock()
        robots, seconds = self._robots, answered.seconds
        for place, (asked, decision) in enumerate(zip(answered.asked, answered.decisions, strict=False)):
            name = asked.robot or (tuple(answered.client or ()), place)
            robot = robots.get(name)
            if robot is not None:
                robot.note(asked, decision, seconds, now)
            elif len(robots) < MOST_ROBOTS or self._makes_room(now):
                robots[name] = Robot(asked, decision, seconds, now)

    async def stream(self, robot: str | None) -> AsyncIterator[str]:
        """The events for one watcher, as server-sent events: one `about`, then an `update` a tick.

        Args:
            robot: the name of the robot that is looked at; None: the first.
        """
        if self.full:
            return
        watcher = Watcher(robot)
        self._watchers.add(watcher)
        if self._task is None:
            for known in self._robots.values():
                known.begin()
            self._task = asyncio.get_running_loop().create_task(self._run())
        try:
            yield f"event: about\ndata: {self._about}\n\n"
            while (update := await watcher.take()) is not None:
                yield f"data: {update}\n\n"
        finally:
            self._watchers.discard(watcher)

    def close(self) -> None:
        """Ends all streams: the service stops."""
        self._closed = True
        for watcher in self._watchers:
            watcher.close()

    async def _run(self) -> None:
        """Updates whoever watches, until nobody does."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        try:
            while self._watchers and not self._closed:
                due = max(due + TICK, loop.time())
                await asyncio.sleep(due - loop.time())
                await self._update()
        except Exception as error:  # noqa: BLE001 - the page may go, the service may not
            self.faults.note(type(error).__name__, "the page could not be told", error)
            for watcher in self._watchers:
                watcher.close()
        finally:
            self._task = None

    async def _update(self) -> None:
        now = self._clock()
        for watcher in [one for one in self._watchers if one.waits(now) > self._patience]:
            watcher.close()
            self._watchers.discard(watcher)
        for name in [name for name, robot in self._robots.items() if now - robot.heard > _FORGOTTEN]:
            del self._robots[name]
        named = {_text(name): robot for name, robot in self._robots.items()}
        told = {
            "at": time.time(),
            "crowded": now - self._crowded < _SILENT,
            "operation": dict(self._operation.snapshot()),
            "robots": {text: robot.told(now) for text, robot in named.items()},
        }
        for robot in named.values():
            robot.begin()
        shared = json.dumps(told, allow_nan=False)[:-1]
        looked: dict[str | None, str] = {}
        for watcher in list(self._watchers):
            if watcher.robot not in looked:
                await asyncio.sleep(0)
                looked[watcher.robot] = self._look(named, watcher.robot)
            watcher.put(f"{shared}, {looked[watcher.robot]}}}", now)

    def _look(self, named: dict[str, Robot], wanted: str | None) -> str:
        """What the robot sees that is looked at, as JSON."""
        text = wanted if wanted in named else next(iter(named), None)
        view = None if text is None else self._views.of(named[text].asked, named[text].decision)
        return f'"looked": {json.dumps(text)}, "view": {json.dumps(view, allow_nan=False)}'

    def _makes_room(self, now: float) -> bool:
        """Whether the robot that was looked at for the longest time ago was silent and is gone."""
        self._crowded = now
        name = next(iter(self._robots))
        robot = self._robots.pop(name)
        if now - robot.heard > _SILENT:
            return True
        self._robots[name] = robot
        return False


def _text(name: Name) -> str:
    """A robot's name as it is shown; that of its connection has a slash, which no robot's own name has."""
    if isinstance(name, str):
        return name
    client, place = name
    host, port = client or ("unknown", 0)
    return f"{host}:{port}/{place + 1}"


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
