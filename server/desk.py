"""Where decisions are asked for: `POST /act` for one robot, `POST /act/batch` for many."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from decision import MEMORY, Decision, Memory, copy_of, memory_from_json
from monitor import Monitor
from server.freshness import Freshness, Unfit
from server.guard import AT_ONCE, RETRY_AFTER, BodyTooLargeError
from server.hands import Hands, LateError
from server.keys import ACT, BATCH
from server.observer import Answered, Observer
from server.places import FullError, Places
from server.safety import Safety
from server.schema import ActRequest, BatchReply, BatchRequest, ModelReply, Refusal, Reply, reply_of

FloatArray = NDArray[np.float64]

UNDECIDED = "not decided: "
"""What the reason begins with where the monitor was not asked, or did not answer in time."""

_MAX_ERRORS = 8
_QUICK = 0.005
"""A decision within this time is made at once [s]: a health check may wait for it."""
_QUICK_ENOUGH = 20
"""So many quick ones in a row, and the next is expected to be quick."""


class Answer(NamedTuple):
    """What is answered, and about whom was decided."""

    status: int
    body: bytes
    asked: Sequence[ActRequest] = ()
    """The requests that were decided about, in order."""
    decisions: Sequence[Decision] = ()
    """What was decided about each."""


Problem = tuple[list[str | int], str, str]
"""Where in the body, what is wrong, and its kind."""
Validated = TypeVar("Validated", bound=BaseModel)


class RefusedError(ValueError):
    """A request that cannot be decided about.

    Attributes:
        errors: what is wrong with it.
    """

    def __init__(self, errors: list[Problem]) -> None:
        super().__init__(errors)
        self.errors = errors


class Desk:
    """Answers `POST /act` and `POST /act/batch`, and hands everything else on.

    A decision takes a fraction of a millisecond and is made at once; another thread would cost 50 us more.
    While decisions are slow, and until they have been seen to be quick, they are made in a thread, so that
    health checks do not wait for them. Where there is a deadline they always are: nothing can interrupt the
    event loop's own thread, and whatever hung there would hold up every robot.

    Args:
        app: what answers the other paths.
        monitor: what decides.
        model: what it told of itself.
        observers: told of every answer, in order.
        safety: how long a decision may take, and how many may wait for theirs.
        freshness: what knows the robots; None: whatever comes is fresh.
    """

    def __init__(
        self,
        app: ASGIApp,
        monitor: Monitor,
        model: ModelReply,
        observers: Sequence[Observer] = (),
        safety: Safety | None = None,
        freshness: Freshness | None = None,
    ) -> None:
        limits = safety or Safety()
        self._app = app
        self._monitor = monitor
        self._model = model
        self._observers = observers
        self._freshness = freshness
        self._hands = Hands(limits.deadline)
        self._places = Places(limits.max_in_flight, limits.max_in_flight_all)
        self._quick = 0
        self._answers = {ACT: self._one, BATCH: self._batch}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request."""
        answers = self._answers.get(scope["path"]) if scope["type"] == "http" else None
        if answers is None or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        content = b""
        received = time.time_ns()
        try:
            content = await _body(receive)
            received = time.time_ns()
            answer = await self.decided(scope["path"], content, started, scope.get("client"))
        except BodyTooLargeError as error:
            answer = _problem(413, [([], str(error), "too_large")])
        if self._observers:
            seconds = time.perf_counter() - started
            client = scope.get("client")
            answered = Answered(received, client, scope["path"], content, seconds, *answer)
            for observer in self._observers:
                observer.answered(answered)
        await _reply(scope, send, answer.status, answer.body)

    def answer(self, content: bytes, batch: bool) -> Answer:
        """The answer to the body of a `POST /act`, or of a `POST /act/batch`."""
        now = time.perf_counter()
        return self._answers[BATCH if batch else ACT](content, now, now)

    async def decided(
        self, path: str, content: bytes, started: float, client: tuple[str, int] | None
    ) -> Answer:
        """The answer to a body, in time.

        Args:
            path: "/act" or "/act/batch".
            content: the body.
            started: when its request began, on the clock of `time.perf_counter` [s].
            client: address and port of who asks.
        """
        answers, arrived = self._answers[path], time.perf_counter()
        if self._hands.deadline is None and self._quick >= _QUICK_ENOUGH and path == ACT:
            return answers(content, started, arrived)
        try:
            with self._places.taken("" if client is None else client[0]):
                return await self._hands.make(partial(answers, content, started, arrived))
        except FullError as full:
            return _problem(503, [([], str(full), "overloaded")])
        except LateError as late:
            self._monitor.faults.note("deadline", str(late))
            return answers(content, started, arrived, str(late))

    def _one(self, content: bytes, started: float, arrived: float, lost: str | None = None) -> Answer:
        """Answers the body of `POST /act`; with the fallback, if what else could have been is lost."""
        begun = time.perf_counter()
        answer = self._guarded(lambda: self._decide(content, started, arrived, lost))
        self._quick = self._quick + 1 if time.perf_counter() - begun < _QUICK else 0
        return answer

    def _batch(self, content: bytes, started: float, arrived: float, lost: str | None = None) -> Answer:
        """Answers the body of `POST /act/batch`."""
        return self._guarded(lambda: self._decide_batch(content, started, arrived, lost))

    def _guarded(self, decide: Callable[[], tuple[BaseModel, list[ActRequest], list[Decision]]]) -> Answer:
        try:
            reply, asked, decisions = decide()
            return Answer(200, reply.model_dump_json().encode(), asked, decisions)
        except RefusedError as error:
            return _problem(422, error.errors)
        except Exception as error:  # noqa: BLE001 - counted and logged; the client has a fallback of its own
            self._monitor.faults.note(type(error).__name__, "the decision could not be told", error)
            return _problem(500, [([], "internal error", "internal")])

    def _decide(
        self, content: bytes, started: float, arrived: float, lost: str | None
    ) -> tuple[BaseModel, list[ActRequest], list[Decision]]:
        asked, memory = self._read(lambda: ActRequest.model_validate_json(content))
        unfit = self._unfit(asked, arrived, lost)
        if unfit is None:
            decision = self._monitor.decide(asked.observation, asked.hazards, memory)
        else:
            decision = self._fall_back(memory, unfit)
        return self._told(decision, asked, started), [asked], [decision]

    def _decide_batch(
        self, content: bytes, started: float, arrived: float, lost: str | None
    ) -> tuple[BaseModel, list[ActRequest], list[Decision]]:
        """One call of the monitor for all robots whose requests are in order; the others are told why not."""
        replies: list[Reply | Refusal] = []
        rows: list[tuple[int, ActRequest, Memory | None]] = []
        told: dict[int, tuple[ActRequest, Decision]] = {}
        batch = _validated(lambda: BatchRequest.model_validate(_parsed(content)))
        for place, robot in enumerate(batch.robots):
            try:
                asked, memory = self._read(partial(ActRequest.model_validate, robot))
                replies.append(Refusal(detail=[]))
                if (unfit := self._unfit(asked, arrived, lost)) is None:
                    rows.append((place, asked, memory))
                else:
                    told[place] = asked, self._fall_back(memory, unfit)
            except RefusedError as error:
                replies.append(Refusal(detail=_detail(error.errors)))
        if rows:
            decisions = self._monitor.decide_batch(
                np.array([asked.observation for _, asked, _ in rows]),
                _hazards([asked.hazards or [] for _, asked, _ in rows]),
                np.concatenate([np.zeros(1, MEMORY) if memory is None else memory for _, _, memory in rows]),
            )
            most = max(len(asked.hazards or []) for _, asked, _ in rows)
            for row, (place, asked, _) in enumerate(rows):
                told[place] = asked, _of_its_own(decisions[row], len(asked.hazards or []), most)
        in_order = [told[place] for place in sorted(told)]
        for place, (asked, decision) in told.items():
            replies[place] = self._told(decision, asked, started)
        decided = [decision for _, decision in in_order]
        return BatchReply(replies=replies), [asked for asked, _ in in_order], decided

    def _read(self, validate: Callable[[], ActRequest]) -> tuple[ActRequest, Memory | None]:
        """One robot's request, and its memory.

        Raises:
            RefusedError: if it cannot be decided about.
        """
        asked = _validated(validate)
        size = self._model.observation_size
        if len(asked.observation) != size:
            message = f"must have {size} numbers, got {len(asked.observation)}"
            raise RefusedError([(["observation"], message, "wrong_length")])
        try:
            return asked, None if asked.memory is None else memory_from_json(asked.memory.model_dump())
        except ValueError as error:
            raise RefusedError([(["memory"], str(error), "wrong_memory")]) from error

    def _unfit(self, asked: ActRequest, arrived: float, lost: str | None) -> Unfit | None:
        """Why a robot gets the fallback instead of a decision, if it does."""
        if self._freshness is None:
            return None if lost is None else Unfit("deadline", lost)
        if lost is None:
            return self._freshness.see(asked.robot, asked.stamp, arrived)
        self._freshness.missed(asked.robot)
        return Unfit("deadline", lost)

    def _fall_back(self, memory: Memory | None, unfit: Unfit) -> Decision:
        """The plan goes on, unless it is over; then the safe action."""
        past = np.zeros(1, MEMORY) if memory is None else copy_of(memory)
        if unfit.over:
            past["left"] = 0
        return self._monitor.fall_back(past, UNDECIDED + unfit.reason)[0]

    def _told(self, decision: Decision, asked: ActRequest, started: float) -> Reply:
        seconds = time.perf_counter() - started
        return reply_of(decision, asked.request, self._model.model, self._model.gate, seconds)


def _validated(validate: Callable[[], Validated]) -> Validated:
    try:
        return validate()
    except ValidationError as error:
        where = [(list(item["loc"]), item["msg"], item["type"]) for item in error.errors()]
        raise RefusedError(where) from error


def _parsed(content: bytes) -> Any:
    try:
        return from_json(content)
    except ValueError as error:
        raise RefusedError([([], f"Invalid JSON: {error}", "json_invalid")]) from error


def _hazards(given: list[list[list[float]]]) -> FloatArray:
    """Hazards (N, n, 2); rows of NaN stand for none."""
    hazards = np.full((len(given), max(map(len, given)), 2), np.nan)
    for row, places in enumerate(given):
        hazards[row, : len(places)] = np.reshape(places, (-1, 2))
    return hazards


def _of_its_own(decision: Decision, given: int, most: int) -> Decision:
    """The decision with its hazard counted among the robot's own: what the lidar shows comes after them."""
    if decision.hazard is None or decision.hazard < most or given == most:
        return decision
    return replace(decision, hazard=decision.hazard - most + given)


async def _body(receive: Receive) -> bytes:
    """A request's body.

    Raises:
        BodyTooLargeError: if it is.
        ClientDisconnect: if its sender hangs up.
    """
    parts = []
    more = True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        parts.append(message.get("body", b""))
        more = message.get("more_body", False)
    return parts[0] if len(parts) == 1 else b"".join(parts)


async def _reply(scope: Scope, send: Send, status: int, content: bytes) -> None:
    """Sends JSON; in one packet where the server can."""
    at_once = scope.get("extensions", {}).get(AT_ONCE)
    if at_once is not None and status != 503 and at_once(status, content):
        return
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(content))]
    if status == 503:
        headers.append(RETRY_AFTER)
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})


def _problem(status: int, errors: list[Problem]) -> Answer:
    """An error in FastAPI's form."""
    return Answer(status, json.dumps({"detail": _detail(errors)}).encode())


def _detail(errors: list[Problem]) -> list[dict[str, Any]]:
    """The input is left out: it may be NaN or very long."""
    return [
        {"loc": ["body", *where], "msg": message, "type": kind}
        for where, message, kind in errors[:_MAX_ERRORS]
    ]
