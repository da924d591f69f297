"""Where decisions are asked for: `POST /act` for one robot, `POST /act/batch` for many."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json, to_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from decision import MEMORY, Decision
from monitor import Monitor
from server.guard import ACT, AT_ONCE, BATCH, BodyTooLargeError
from server.keeper import Keeper, Past
from server.observer import Answered, Observer
from server.schema import ActRequest, BatchRequest, ModelReply, reply_of

FloatArray = NDArray[np.float64]

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


class Codec(NamedTuple):
    """How the body of a request is read, and that of its answer written."""

    read: Callable[[bytes], ActRequest]
    write: Callable[[Any], bytes]


def _from_msgpack(content: bytes) -> ActRequest:
    try:
        unpacked = msgpack.unpackb(content)
    except ValueError as error:
        raise RefusedError([([], f"Invalid msgpack: {error}", "msgpack_invalid")]) from error
    return ActRequest.model_validate(unpacked)


JSON = Codec(ActRequest.model_validate_json, to_json)
MSGPACK = Codec(_from_msgpack, msgpack.packb)


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

    A decision takes a fraction of a millisecond and is made at once; another thread would cost as much again.
    While decisions are slow, and until they have been seen to be quick, they are made in a thread, so that
    health checks do not wait for them.

    Args:
        app: what answers the other paths.
        monitor: what decides.
        model: what it told of itself.
        keeper: looks through the memories that come back.
        observers: told of every answer, in order.
    """

    def __init__(
        self,
        app: ASGIApp,
        monitor: Monitor,
        model: ModelReply,
        keeper: Keeper,
        observers: Sequence[Observer] = (),
    ) -> None:
        self._app = app
        self._monitor = monitor
        self._model = model
        self._keeper = keeper
        self._observers = observers
        self._thread = ThreadPoolExecutor(1, "decisions")
        self._quick = 0
        self._answers = {ACT: self._one, BATCH: self._batch}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request, or one stream of them."""
        path = scope["path"]
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
            return
        if scope["type"] != "http" or path not in self._answers or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        client = scope.get("client")
        try:
            answer = await self.handle(path, await _body(receive), started, client)
        except BodyTooLargeError as error:
            answer = _problem(413, [([], str(error), "too_large")])
            self._tell(time.time_ns(), client, path, b"", started, answer)
        await _reply(scope, send, answer.status, answer.body)

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one robot's frames in their order, until it hangs up.

        Each frame is the body of a `POST /act`, each answer that of its reply: text frames are JSON, binary
        ones msgpack.
        """
        await receive()
        await send({"type": "websocket.accept"})
        client = scope.get("client")
        while (message := await receive())["type"] == "websocket.receive":
            started = time.perf_counter()
            text = message.get("text")
            reply: Message = {"type": "websocket.send"}
            if text is not None:
                answer = await self.handle(ACT, text.encode(), started, client)
                reply["text"] = answer.body.decode()
            else:
                answer = await self.handle(ACT, message["bytes"], started, client, MSGPACK)
                reply["bytes"] = answer.body
            await send(reply)

    async def handle(
        self,
        path: str,
        content: bytes,
        started: float,
        client: tuple[str, int] | None,
        codec: Codec = JSON,
    ) -> Answer:
        """The answer to one body, of which whoever looks on is told.

        Args:
            path: "/act" or "/act/batch".
            content: the body.
            started: when its request began, on the clock of `time.perf_counter` [s].
            client: address and port of who asks.
            codec: how bodies are written; a batch's are JSON.
        """
        received = time.time_ns()
        answers = self._one if path == ACT else self._batch
        if self._quick >= _QUICK_ENOUGH and path == ACT:
            answer = answers(content, started, codec)
        else:
            loop = asyncio.get_running_loop()
            answer = await loop.run_in_executor(self._thread, answers, content, started, codec)
        if self._observers:
            self._tell(received, client, path, content, started, answer, codec)
        return answer

    def _tell(
        self,
        received: int,
        client: tuple[str, int] | None,
        path: str,
        content: bytes,
        started: float,
        answer: Answer,
        codec: Codec = JSON,
    ) -> None:
        """Tells whoever looks on of an answer, in JSON."""
        seconds = time.perf_counter() - started
        if codec is not JSON:
            content = b"".join(asked.model_dump_json().encode() for asked in answer.asked[:1])
            answer = answer._replace(body=to_json(msgpack.unpackb(answer.body)))
        answered = Answered(received, client, path, content, seconds, *answer)
        for observer in self._observers:
            observer.answered(answered)

    def answer(self, content: bytes, batch: bool) -> Answer:
        """The answer to the body of a `POST /act`, or of a `POST /act/batch`."""
        return self._answers[BATCH if batch else ACT](content, time.perf_counter(), JSON)

    def _one(self, content: bytes, started: float, codec: Codec) -> Answer:
        """Answers the body of `POST /act`."""
        begun = time.perf_counter()
        answer = self._guarded(lambda: self._decide(content, started, codec), codec)
        self._quick = self._quick + 1 if time.perf_counter() - begun < _QUICK else 0
        return answer

    def _batch(self, content: bytes, started: float, codec: Codec) -> Answer:
        """Answers the body of `POST /act/batch`."""
        return self._guarded(lambda: self._decide_batch(content, started), codec)

    def _guarded(
        self, decide: Callable[[], tuple[dict[str, Any], list[ActRequest], list[Decision]]], codec: Codec
    ) -> Answer:
        try:
            reply, asked, decisions = decide()
            return Answer(200, codec.write(reply), asked, decisions)
        except RefusedError as error:
            return _problem(422, error.errors, codec)
        except Exception as error:  # noqa: BLE001 - counted and logged; the client has a fallback of its own
            self._monitor.faults.note(type(error).__name__, "the decision could not be told", error)
            return _problem(500, [([], "internal error", "internal")], codec)

    def _decide(
        self, content: bytes, started: float, codec: Codec
    ) -> tuple[dict[str, Any], list[ActRequest], list[Decision]]:
        asked, past = self._read(lambda: codec.read(content))
        decision = self._decide_one(asked, past)
        return self._told(decision, asked, past, started), [asked], [decision]

    def _decide_batch(
        self, content: bytes, started: float
    ) -> tuple[dict[str, Any], list[ActRequest], list[Decision]]:
        """One call of the monitor for all robots whose requests are in order; the others are told why not."""
        replies: list[dict[str, Any]] = []
        rows: list[tuple[int, ActRequest, Past]] = []
        told: dict[int, tuple[ActRequest, Past, Decision]] = {}
        batch = _validated(lambda: BatchRequest.model_validate(_parsed(content)))
        for place, robot in enumerate(batch.robots):
            replies.append({})
            try:
                asked, past = self._read(partial(ActRequest.model_validate, robot))
            except RefusedError as error:
                replies[place] = {"detail": _detail(error.errors)}
                continue
            if past.lost is None:
                rows.append((place, asked, past))
            else:
                decision = self._decide_one(asked, past)
                told[place] = asked, past, decision
        if rows:
            decisions = self._monitor.decide_batch(
                np.array([asked.observation for _, asked, _ in rows]),
                _hazards([asked.hazards or [] for _, asked, _ in rows]),
                np.concatenate(
                    [np.zeros(1, MEMORY) if it.memory is None else it.memory for _, _, it in rows]
                ),
            )
            most = max(len(asked.hazards or []) for _, asked, _ in rows)
            for row, (place, asked, past) in enumerate(rows):
                told[place] = asked, past, _of_its_own(decisions[row], len(asked.hazards or []), most)
        for place, (asked, past, decision) in told.items():
            replies[place] = self._told(decision, asked, past, started)
        in_order = [told[place] for place in sorted(told)]
        return {"replies": replies}, [it[0] for it in in_order], [it[2] for it in in_order]

    def _decide_one(self, asked: ActRequest, past: Past) -> Decision:
        if past.lost is None:
            return self._monitor.decide(asked.observation, asked.hazards, past.memory)
        return self._monitor.decide_lost(asked.observation, asked.hazards, past.memory, past.lost)

    def _read(self, validate: Callable[[], ActRequest]) -> tuple[ActRequest, Past]:
        """One robot's request, and what to go by.

        Raises:
            RefusedError: if it cannot be decided about.
        """
        asked = _validated(validate)
        size = self._model.observation_size
        if len(asked.observation) != size:
            message = f"must have {size} numbers, got {len(asked.observation)}"
            raise RefusedError([(["observation"], message, "wrong_length")])
        return asked, self._keeper.past(asked.memory, asked.played, asked.robot, self._model.model)

    def _told(self, decision: Decision, asked: ActRequest, past: Past, started: float) -> dict[str, Any]:
        model = self._model
        memory = self._keeper.seal(decision.memory, asked.robot, model.model, past)
        seconds = time.perf_counter() - started
        return reply_of(decision, memory, asked.request, model.model, model.gate, seconds)


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
    if at_once is not None and at_once(status, content):
        return
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(content))]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})


def _problem(status: int, errors: list[Problem], codec: Codec = JSON) -> Answer:
    """An error in FastAPI's form, and its status, which a frame does not have beside it."""
    return Answer(status, codec.write({"status": status, "detail": _detail(errors)}))


def _detail(errors: list[Problem]) -> list[dict[str, Any]]:
    """The input is left out: it may be NaN or very long."""
    return [
        {"loc": ["body", *where], "msg": message, "type": kind}
        for where, message, kind in errors[:_MAX_ERRORS]
    ]
