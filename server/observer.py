"""Who looks on while decisions are answered: the recording, the metrics, the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from decision import Decision
from recorder import Recorder
from server.schema import ActRequest

_RECORDED = (200, 500)
"""The statuses of decisions, and of those that could not be told."""


@dataclass(frozen=True, slots=True)
class Answered:
    """A request for decisions, and its answer.

    Attributes:
        received: when the request had come [ns since 1970].
        client: address and port of who asked.
        path: "/act" or "/act/batch".
        request: its body.
        seconds: from its head to the answer [s].
        status: the answer's.
        reply: its body.
        asked: the requests that were decided about; a batch leaves out those that were refused.
        decisions: what was decided about each.
    """

    received: int
    client: tuple[str, int] | None
    path: str
    request: bytes
    seconds: float
    status: int
    reply: bytes
    asked: Sequence[ActRequest]
    decisions: Sequence[Decision]


class Observer(Protocol):
    """Is told of every answer, in the event loop's thread and before it is sent: it must be quick."""

    def answered(self, answered: Answered) -> None:
        """Takes note of one request and its answer, refusals included."""


class Recording:
    """Hands decisions on to a recorder.

    Args:
        recorder: what writes them.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def answered(self, answered: Answered) -> None:
        """Records the decisions of one request."""
        if answered.status in _RECORDED:
            self._recorder.record(
                answered.received, answered.client, answered.status, answered.request, answered.reply
            )
