"""Who looks on while decisions are answered: the recording, the metrics, the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from decision import Decision
from recorder import Recorder
from server.schema import ActRequest, ModelReply

_RECORDED = (200, 500)
"""The statuses of decisions, and of those that could not be told."""


class Answered(NamedTuple):
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
        model: what the one who decided tells of itself; None where nobody did.
        queued: from its last byte to the decision's begin [s]; NaN where nobody decided.
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
    model: ModelReply | None = None
    queued: float = math.nan


class Observer(Protocol):
    """Is told of every answer, in the event loop's thread and once it is on its way: it must be quick."""

    def answered(self, answered: Answered) -> None:
        """Takes note of one request and its answer, refusals included."""


class Recording:
    """Hands decisions on to a recorder.

    Args:
        recorder: what writes them.
        model: what decides at first, as the recorder was told.
    """

    def __init__(self, recorder: Recorder, model: ModelReply) -> None:
        self._recorder = recorder
        self._model = model

    def answered(self, answered: Answered) -> None:
        """Records the decisions of one request."""
        if answered.status in _RECORDED:
            if answered.model is not None and answered.model is not self._model:
                self._model = answered.model
                self._recorder.change(answered.model.model_dump())
            self._recorder.record(
                answered.received, answered.client, answered.status, answered.request, answered.reply
            )
