"""Where decisions are asked for: `POST /act` for one robot, `POST /act/batch` for many, `WS /act/stream`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from decision import MEMORY, Decision, copy_of
from server.body import JSON, MSGPACK, Answer, Codec, RefusedError, detail_of, parsed, problem, validated
from server.duty import UNDECIDED, Duty, OnDuty
from server.freshness import Freshness, Unfit
from server.guard import AT_ONCE, RETRY_AFTER, BodyTooLargeError
from server.hands import Hands, LateError
from server.keeper import Keeper, Past
from server.keys import ACT, BATCH
from server.observer import Answered, Observer
from server.places import FullError, Places
from server.safety import Safety
from server.schema import ActRequest, BatchRequest, reply_of

FloatArray = NDArray[np.float64]

_QUICK = 0.005
"""A decision within this time is made at once [s]: a health check may wait for it."""
_QUICK_ENOUGH = 20
"""So many quick ones in a row, and the next is expected to be quick."""

Client = tuple[str, int] | None
"""Address and port of who asks."""
Decided = tuple[dict[str, Any], list[ActRequest], list[Decision]]
"""The reply, who was decided about, and what was decided."""


class Desk:
    """Answers `POST /act`, `POST /act/batch` and `WS /act/stream`, and hands everything else on.

    A decision takes a fraction of a millisecond and is made at once; another thread would cost 50 us more.
    While decisions are slow, and until they have been seen to be quick, they are made in a thread, so that
    health checks do not wait for them. Where there is a deadline they always are: nothing can interrupt the
    event loop's own thread, and whatever hung there would hold up every robot.

    Args:
        app: what answers the other paths.
        duty: who decides.
        keeper: looks through the memories that come back.
        observers: told of every answer, in order, once it is on its way: a robot waits for nobody.
        safety: how long a decision may take, and how many may wait for theirs.
        freshness: what knows the robots; None: whatever comes is fresh.
    """

    def __init__(
        self,
        app: ASGIApp,
        duty: Duty,
        keeper: Keeper,
        observers: Sequence[Observer] = (),
        safety: Safety | None = None,
        freshness: Freshness | None = None,
    ) -> None:
        limits = safety or Safety()
        self._app = app
        self._duty = duty
        self._keeper = keeper
        self._observers = observers
        self._freshness = freshness
        self._hands = Hands(limits.deadline)
        self._places = Places(limits.max_in_flight, limits.max_in_flight_all)
        self._quick = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request, or one stream of them."""
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
            return
        path = scope["path"] if scope["type"] == "http" else None
        if path not in (ACT, BATCH) or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        content = b""
        received, ready = time.time_ns(), started
        try:
            content = await _body(receive)
            received, ready = time.time_ns(), time.perf_counter()
            answer = await self.decided(path, content, started, scope.get("client"))
        except BodyTooLargeError as error:
            answer = problem(413, [([], str(error), "too_large")])
        seconds = time.perf_counter() - started
        try:
            await _reply(scope, send, answer.status, answer.body)
        finally:
            about = received, scope.get("client"), path, content, seconds
            self._tell(Answered(*about, *answer[:-1], answer.begun - ready))

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one robot's frames in their order, until it hangs up.

        Each frame is the body of a `POST /act`, each answer that of its reply: text frames are JSON, binary
        ones msgpack.
        """
        await receive()
        await send({"type": "websocket.accept"})
        client = scope.get("client")
        while (message := await receive())["type"] == "websocket.receive":
            received, started = time.time_ns(), time.perf_counter()
            text = message.get("text")
            codec = MSGPACK if text is None else JSON
            content = message["bytes"] if text is None else text.encode()
            answer = await self.decided(ACT, content, started, client, codec)
            seconds = time.perf_counter() - started
            reply: Message = {"type": "websocket.send"}
            if text is None:
                reply["bytes"] = answer.body
            else:
                reply["text"] = answer.body.decode()
            try:
                await send(reply)
            finally:
                if codec is not JSON:
                    # Whoever looks on reads JSON.
                    content = b"".join(asked.model_dump_json().encode() for asked in answer.asked)
                    answer = answer._replace(body=to_json(msgpack.unpackb(answer.body)))
                about = received, client, ACT, content, seconds
                self._tell(Answered(*about, *answer[:-1], answer.begun - started))

    def _tell(self, answered: Answered) -> None:
        for observer in self._observers:
            try:
                observer.answered(answered)
            except Exception as error:  # noqa: BLE001 - whoever looks on may miss an answer, no robot may
                kind = f"observer {type(observer).__name__}"
                self._duty.now.monitor.faults.note(kind, "it missed an answer", error, internal=False)

    def answer(self, content: bytes, batch: bool) -> Answer:
        """The answer to the body of a `POST /act`, or of a `POST /act/batch`."""
        now = time.perf_counter()
        return self._batch(content, now, now) if batch else self._one(content, now, now)

    async def decided(
        self, path: str, content: bytes, started: float, client: Client, codec: Codec = JSON
    ) -> Answer:
        """The answer to a body, in time.

        Args:
            path: "/act" or "/act/batch".
            content: the body.
            started: when its request began, on the clock of `time.perf_counter` [s].
            client: who asks.
            codec: how bodies are written; a batch's are JSON.
        """
        arrived = time.perf_counter()
        if path == ACT:
            if self._hands.deadline is None and self._quick >= _QUICK_ENOUGH:
                return self._one(content, started, arrived, codec=codec)
            answers = partial(self._one, content, started, arrived, codec=codec)
        else:
            answers = partial(self._batch, content, started, arrived)
        try:
            with self._places.taken("" if client is None else client[0]):
                return await self._hands.make(answers)
        except FullError as full:
            return problem(503, [([], str(full), "overloaded")], codec)
        except LateError as late:
            self._duty.now.monitor.faults.note("deadline", str(late))
            return answers(late=str(late))

    def _one(
        self, content: bytes, started: float, arrived: float, late: str | None = None, codec: Codec = JSON
    ) -> Answer:
        """Answers the body of `POST /act`; with the fallback, if its decision comes too late."""
        begun = time.perf_counter()
        answer = self._guarded(lambda now: self._decide(now, content, started, arrived, late, codec), codec)
        self._quick = self._quick + 1 if time.perf_counter() - begun < _QUICK else 0
        return answer

    def _batch(self, content: bytes, started: float, arrived: float, late: str | None = None) -> Answer:
        """Answers the body of `POST /act/batch`."""
        return self._guarded(lambda now: self._decide_batch(now, content, started, arrived, late), JSON)

    def _guarded(self, decide: Callable[[OnDuty], Decided], codec: Codec) -> Answer:
        begun, now = time.perf_counter(), self._duty.now
        try:
            reply, asked, decisions = decide(now)
            return Answer(200, codec.write(reply), asked, decisions, now.model, begun)
        except RefusedError as error:
            return problem(422, error.errors, codec)
        except Exception as error:  # noqa: BLE001 - counted and logged; the client has a fallback of its own
            now.monitor.faults.note(type(error).__name__, "the decision could not be told", error)
            return problem(500, [([], "internal error", "internal")], codec)

    def _decide(
        self, now: OnDuty, content: bytes, started: float, arrived: float, late: str | None, codec: Codec
    ) -> Decided:
        asked, past = self._read(now, lambda: codec.read(content))
        decision = self._undecided(now, asked, past, arrived, late)
        if decision is None:
            decision = _decision(now, asked, past)
        return self._told(now, decision, asked, past, started), [asked], [decision]

    def _decide_batch(
        self, now: OnDuty, content: bytes, started: float, arrived: float, late: str | None
    ) -> Decided:
        """One call of the monitor for all robots whose requests are in order; the others are told why not."""
        replies: list[dict[str, Any]] = []
        rows: list[tuple[int, ActRequest, Past]] = []
        told: dict[int, tuple[ActRequest, Past, Decision]] = {}
        batch = validated(lambda: BatchRequest.model_validate(parsed(content)))
        for place, robot in enumerate(batch.robots):
            replies.append({})
            try:
                asked, past = self._read(now, partial(ActRequest.model_validate, robot))
            except RefusedError as error:
                replies[place] = {"detail": detail_of(error.errors)}
                continue
            decision = self._undecided(now, asked, past, arrived, late)
            if decision is None and past.lost is not None:
                decision = _decision(now, asked, past)
            if decision is None:
                rows.append((place, asked, past))
            else:
                told[place] = asked, past, decision
        if rows:
            decisions = now.decider.decide_batch(
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
            replies[place] = self._told(now, decision, asked, past, started)
        in_order = [told[place] for place in sorted(told)]
        return {"replies": replies}, [it[0] for it in in_order], [it[2] for it in in_order]

    def _read(self, now: OnDuty, validate: Callable[[], ActRequest]) -> tuple[ActRequest, Past]:
        """One robot's request, and what to go by.

        Raises:
            RefusedError: if it cannot be decided about.
        """
        asked = validated(validate)
        size = now.model.observation_size
        if len(asked.observation) != size:
            message = f"must have {size} numbers, got {len(asked.observation)}"
            raise RefusedError([(["observation"], message, "wrong_length")])
        return asked, self._keeper.past(asked.memory, asked.played, asked.robot, now.robot)

    def _undecided(
        self, now: OnDuty, asked: ActRequest, past: Past, arrived: float, late: str | None
    ) -> Decision | None:
        """The fallback of a robot that gets no decision: its plan goes on, unless that is over."""
        unfit = self._unfit(asked, arrived, late)
        if unfit is None:
            return None
        memory = np.zeros(1, MEMORY) if past.memory is None else copy_of(past.memory)
        if unfit.over:
            memory["left"] = 0
        return now.monitor.fall_back(memory, UNDECIDED + unfit.reason)[0]

    def _unfit(self, asked: ActRequest, arrived: float, late: str | None) -> Unfit | None:
        """Why a robot gets the fallback instead of a decision, if it does."""
        if self._freshness is None:
            return None if late is None else Unfit("deadline", late)
        if late is None:
            return self._freshness.see(asked.robot, asked.stamp, arrived)
        self._freshness.missed(asked.robot)
        return Unfit("deadline", late)

    def _told(
        self, now: OnDuty, decision: Decision, asked: ActRequest, past: Past, started: float
    ) -> dict[str, Any]:
        memory = self._keeper.seal(decision.memory, asked.robot, now.robot, past)
        seconds = time.perf_counter() - started
        return reply_of(decision, memory, asked.request, now.model.model, now.model.gate, seconds)


def _decision(now: OnDuty, asked: ActRequest, past: Past) -> Decision:
    if past.lost is None:
        return now.decider.decide(asked.observation, asked.hazards, past.memory)
    return now.decider.decide_lost(asked.observation, asked.hazards, past.memory, past.lost)


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
