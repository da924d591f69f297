"""What becomes of an evaluation whose service goes away."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from decision import BatchDecider, Decision, Decisions, Memory
from evaluation.errors import ServiceError, ServiceGoneError

_MEASURED = ("bad input", "time-out")
"""Kinds of faults that are the robots' fate, not the evaluation's end: they are in its figures."""


class Faults(Protocol):
    """What went wrong on the robots' side."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Kind → how many there were."""


class Asks(BatchDecider, Protocol):
    """Decides through a service; `server.Fleet` is one."""

    @property
    def faults(self) -> Faults:
        """What went wrong so far; the service's own faults are not among them."""


class Watched:
    """Decides through a service, and raises once that is gone.

    Robots whose service does not answer go on by themselves; figures of such a drive would say nothing of
    the service. So the robots' own faults end it: a connection that failed, an answer that is none. A late
    reply does not, and is in the figures as the fallback that it was; but where none of the robots had its
    reply in time, the service is asked whether it is there at all. A fallback that the service itself decided
    on is a decision like any other.

    Args:
        fleet: decides through the service.
        probe: asks whether the service is there.

    Raises:
        ServiceGoneError: from `decide` and `decide_batch`, if the service is gone.
    """

    def __init__(self, fleet: Asks, probe: Callable[[], None]) -> None:
        self._fleet = fleet
        self._probe = probe

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """Decides for one robot."""
        before = dict(self._fleet.faults.counts)
        decision = self._fleet.decide(observation, hazards, memory)
        self._check(before, [decision.reason])
        return decision

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        """Decides for N robots."""
        before = dict(self._fleet.faults.counts)
        decisions = self._fleet.decide_batch(observation, hazards, memory)
        self._check(before, decisions.reason)
        return decisions

    def _check(self, before: Mapping[str, int], reasons: Sequence[str | None]) -> None:
        new = {kind: count - before.get(kind, 0) for kind, count in self._fleet.faults.counts.items()}
        said = next((reason for reason in reversed(reasons) if reason), "it gives no reason")
        if any(count for kind, count in new.items() if kind not in _MEASURED):
            raise ServiceGoneError(f"the service failed while robots were driving: {said}")
        if new.get("time-out", 0) == len(reasons):
            try:
                self._probe()
            except ServiceError as error:
                raise ServiceGoneError(f"the service is gone while robots were driving: {error}") from error
