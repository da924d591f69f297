"""What was asked and answered, counted: plain numbers, a few microseconds a request.

Bound labels and locks of a metrics library would cost several times as much; `server.metrics` reads these
numbers when it is asked.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import accumulate
from math import inf
from typing import TypeVar

from decision import Decision, Mode, OpenedBy, Origin
from server.duty import HELD, UNDECIDED, Duty
from server.observer import Answered

SECONDS = (
    *(1e-5, 2.5e-5, 5e-5, 1e-4, 2e-4, 3e-4, 5e-4, 7.5e-4),
    *(1e-3, 1.5e-3, 2.5e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.25, 1.0),
)
"""Bounds of durations [s]."""
RISKS = (0.001, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
BARRIERS = (-0.2, -0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0)
"""Bounds of barriers [m]: up to 0.0 is not safe."""
NOVELTIES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 5.0, 10.0)

Key = TypeVar("Key")

_FALLBACK = Mode.FALLBACK
_KINDS = (
    (f"{HELD}:", HELD),
    ("no decision within", "deadline"),
    ("decisions hang", "deadline"),
    (UNDECIDED, "stale"),
    ("bad input", "bad input"),
    ("no certified action", "uncertified"),
    ("inside a hazard", "inside a hazard"),
    ("too fast to stay", "too fast"),
    ("shows what", "sensor"),
    ("showed what", "sensor"),
    ("the networks gave", "networks"),
)
"""What a reason has in it → its kind; the first that fits."""
OTHER = "fault"
"""The kind of all other reasons: something failed."""
REASONS = (*dict.fromkeys(kind for _, kind in _KINDS), OTHER)
"""All kinds of reasons."""


def kind_of(reason: str | None) -> str:
    """The kind of a fallback's reason, one of `REASONS`: the texts themselves name numbers and files."""
    return next((kind for text, kind in _KINDS if text in (reason or "")), OTHER)


def _summed(counts: Iterable[tuple[Key, int]]) -> Counter[Key]:
    total: Counter[Key] = Counter()
    for key, count in counts:
        total[key] += count
    return total


class Histogram:
    """How often a number was at most so much.

    Args:
        bounds: in order; beyond the last comes infinity.

    Attributes:
        counts: for each bound, how often a number was at most it and above the one before.
        sum: of all numbers.
    """

    __slots__ = ("bounds", "counts", "sum")

    def __init__(self, bounds: Sequence[float]) -> None:
        self.bounds = bounds
        self.counts = [0] * (len(bounds) + 1)
        self.sum = 0.0

    def add(self, number: float) -> None:
        """Counts a number; one that is not finite is none."""
        if -inf < number < inf:
            self.counts[bisect_left(self.bounds, number)] += 1
            self.sum += number

    def cumulated(self) -> list[tuple[str, float]]:
        """Bound and count up to it, as Prometheus has it."""
        return list(zip(map(str, (*self.bounds, "+Inf")), accumulate(self.counts), strict=True))

    def quantile(self, share: float, before: Sequence[int] | None = None) -> float | None:
        """The bound below which a share of the numbers lies; infinity beyond the last one, None without any.

        Args:
            share: in 0..1.
            before: the counts at an earlier time, which are left out.
        """
        counts = self.counts if before is None else [a - b for a, b in zip(self.counts, before, strict=True)]
        wanted = share * sum(counts)
        if not wanted:
            return None
        place = bisect_left(list(accumulate(counts)), wanted)
        return self.bounds[place] if place < len(self.bounds) else inf


class Tally:
    """Counts what is answered; an `Observer`.

    Args:
        duty: who decides.

    Attributes:
        requests: path and status → answers.
        outcomes: mode, origin and what opened the gate → decisions.
        fallbacks: decisions in mode "fallback" by kind of reason.
        risky: decisions whose risk score was above the threshold.
        novel: decisions with a novelty above 1.
        seconds: durations of "request", "queue", "inference" and "filter" [s]; the last two once a batch.
        risk, barrier, novelty: of the decisions in which they are known.
    """

    def __init__(self, duty: Duty) -> None:
        self._duty = duty
        self.requests: Counter[tuple[str, int]] = Counter()
        self.outcomes: Counter[tuple[Mode, Origin | None, OpenedBy | None]] = Counter()
        self.fallbacks: Counter[str] = Counter()
        self.risky = self.novel = 0
        self.seconds = {name: Histogram(SECONDS) for name in ("request", "queue", "inference", "filter")}
        self.risk, self.barrier, self.novelty = map(Histogram, (RISKS, BARRIERS, NOVELTIES))

    @property
    def decisions(self) -> int:
        """How many decisions there were."""
        return sum(self.outcomes.values())

    @property
    def modes(self) -> Counter[Mode]:
        """Decisions by mode."""
        return _summed((mode, count) for (mode, _, _), count in self.outcomes.items())

    @property
    def origins(self) -> Counter[Origin | None]:
        """Decisions by what the action came from; None for the nominal one."""
        return _summed((origin, count) for (_, origin, _), count in self.outcomes.items())

    @property
    def opened(self) -> Counter[OpenedBy | None]:
        """Decisions by what opened the gate; None where it was closed."""
        return _summed((cause, count) for (_, _, cause), count in self.outcomes.items())

    def answered(self, answered: Answered) -> None:
        """Counts one request and its answer."""
        self.requests[answered.path, answered.status] += 1
        seconds = self.seconds
        seconds["request"].add(answered.seconds)
        seconds["queue"].add(answered.queued)
        laps = self._duty.now.monitor.stopwatch.laps
        while laps:
            name, lap = laps.popleft()
            seconds[name].add(lap)
        for decision in answered.decisions:
            self._decided(decision)

    def _decided(self, decision: Decision) -> None:
        self.outcomes[decision.mode, decision.origin, decision.opened_by] += 1
        self.risky += decision.risk > decision.threshold
        self.novel += decision.novelty > 1.0
        self.risk.add(decision.risk)
        self.barrier.add(decision.barrier)
        self.novelty.add(decision.novelty)
        if decision.mode is _FALLBACK:
            self.fallbacks[kind_of(decision.reason)] += 1

    def counters(self) -> dict[str, int | dict[str, int]]:
        """What was counted, as plain JSON."""
        statuses: Counter[str] = Counter()
        for (_, status), count in self.requests.items():
            statuses[str(status)] += count
        return {
            "decisions": self.decisions,
            "requests": dict(statuses),
            "modes": {str(mode): count for mode, count in self.modes.items()},
            "opened_by": {str(cause or "closed"): count for cause, count in self.opened.items()},
            "origins": {str(origin): count for origin, count in self.origins.items() if origin},
            "fallbacks": dict(self.fallbacks),
            "risky": self.risky,
            "novel": self.novel,
        }
