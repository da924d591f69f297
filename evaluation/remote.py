"""Robots that ask a running service, and what happens when it goes away."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from decision import Decision, Decisions
from evaluation.closed_loop import Decides, FloatArray
from evaluation.errors import ServiceError, ServiceGoneError
from server import ClientError, Fleet, ModelReply
from server.serve import ServeError, read_api_key

_MEASURED = ("bad input", "time-out")
"""Kinds of faults that are the robots' fate, not the evaluation's end: they are in its figures."""


@contextmanager
def asked(
    url: str, layout: Sequence[dict[str, Any]], timeout: float, key_file: Path | None = None
) -> Iterator[tuple[Decides, ModelReply]]:
    """What decides through a service, and what the service says about itself.

    Args:
        url: the service.
        layout: the robots' observation layout; compared with the service's.
        timeout: how long a robot waits for its action [s].
        key_file: holds the service's key; None: the environment may.

    Raises:
        ServiceError: if the service cannot be used.
        ServiceGoneError: within, as soon as it has stopped answering.
    """
    try:
        key = read_api_key(key_file)
        with Fleet(url, layout, timeout, key) as fleet:

            def probe() -> None:
                Fleet(url, layout, timeout, key).close()

            yield Watched(fleet, probe), fleet.model()
    except (ClientError, ServeError) as error:
        raise ServiceError(str(error)) from error


class _Faults(Protocol):
    @property
    def counts(self) -> dict[str, int]: ...


class _Asks(Decides, Protocol):
    @property
    def faults(self) -> _Faults: ...


class Watched:
    """Decides through a service, and raises once that is gone.

    Robots whose service does not answer go on by themselves; figures of such a drive would say nothing of
    the service. So the clients' own faults end it: a connection that failed, an answer that is none. A late
    reply does not, and is in the figures as the fallback that it was; but where none of the robots had its
    reply in time, the service is asked whether it is there at all.

    Args:
        fleet: decides through the service, and counts its own faults.
        probe: asks whether the service is there; raises ClientError if it is not.
    """

    def __init__(self, fleet: _Asks, probe: Callable[[], None]) -> None:
        self._fleet = fleet
        self._probe = probe

    def decide(self, observation: FloatArray, hazards: Any = None, memory: Any = None) -> Decision:
        """Decides for one robot.

        Raises:
            ServiceGoneError: if the service is gone.
        """
        before = self._counts()
        decision = self._fleet.decide(observation, hazards, memory)
        self._check(before, [decision.reason])
        return decision

    def decide_batch(self, observation: FloatArray, hazards: Any = None, memory: Any = None) -> Decisions:
        """Decides for N robots.

        Raises:
            ServiceGoneError: if the service is gone.
        """
        before = self._counts()
        decisions = self._fleet.decide_batch(observation, hazards, memory)
        self._check(before, decisions.reason)
        return decisions

    def _counts(self) -> dict[str, int]:
        return dict(self._fleet.faults.counts)

    def _check(self, before: dict[str, int], reasons: Sequence[str | None]) -> None:
        new = {kind: count - before.get(kind, 0) for kind, count in self._fleet.faults.counts.items()}
        said = next((reason for reason in reasons if reason), "no reason")
        if any(count for kind, count in new.items() if kind not in _MEASURED):
            raise ServiceGoneError(f"the service failed while robots were driving: {said}")
        if new.get("time-out", 0) == len(reasons):
            try:
                self._probe()
            except ClientError as error:
                raise ServiceGoneError(f"the service is gone while robots were driving: {error}") from error
