"""The HTTP service: `POST /act`, `/model`, `/healthz`, `/readyz`."""

from __future__ import annotations

import asyncio
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from decision import memory_from_json
from monitor import Monitor
from server.guard import AT_ONCE, BodyTooLargeError, Guard
from server.schema import ActReply, ActRequest, ModelReply, reply_of

MAX_BODY = 65536
"""Most bytes of a request's body: 60 numbers and a thousand hazards fit."""
MANY_FAULTS = 5
"""Internal faults within a minute from which on the service is not ready: a robot may live with one."""
_MAX_ERRORS = 8
_QUICK = 0.005
"""A decision within this time is made at once [s]: a health check may wait for it."""
_QUICK_ENOUGH = 20
"""So many quick ones in a row, and the next is expected to be quick."""

Answer = tuple[int, bytes]
"""Status and body."""


@dataclass
class Lifecycle:
    """Where the service stands.

    Attributes:
        draining: it is about to stop: /readyz says 503, requests are still answered.
    """

    draining: bool = False


def create_app(
    monitor: Monitor, lifecycle: Lifecycle | None = None, api_key: str | None = None, max_body: int = MAX_BODY
) -> ASGIApp:
    """The service around one monitor that is loaded and warmed up.

    Args:
        monitor: what decides.
        lifecycle: shared with whoever stops the service.
        api_key: the key that every request but the health checks must carry; None asks for none.
        max_body: most bytes of a request's body.
    """
    state = lifecycle or Lifecycle()
    model = ModelReply.of(monitor)
    # No /docs: its page loads scripts from other hosts. /openapi.json is there.
    app = FastAPI(
        title="Lagnet", description="What a watched robot policy does next.", docs_url=None, redoc_url=None
    )

    # It documents the path; `Desk` answers it before FastAPI is asked, at a third of the cost, and with
    # errors that name the field without repeating the input, which may be NaN.
    @app.post(
        "/act",
        response_model=ActReply,
        responses={
            413: {"description": "body too large"},
            422: {"description": "names the field that is wrong"},
            500: {"description": "the decision could not be told"},
        },
        openapi_extra={
            "requestBody": {"required": True, "content": {"application/json": {"schema": _act_schema(model)}}}
        },
    )
    async def act() -> None:
        raise NotImplementedError

    @app.get("/model", response_model=ModelReply)
    async def about() -> ModelReply:
        return model

    @app.get("/healthz")
    async def healthz() -> dict[str, str]:
        return {"status": "alive"}

    @app.get("/readyz", responses={503: {"description": "draining, or degraded by its own faults"}})
    async def readyz() -> JSONResponse:
        if state.draining:
            return JSONResponse({"status": "draining"}, status_code=503)
        faults = monitor.faults.internal()
        if faults >= MANY_FAULTS:
            return JSONResponse({"status": "degraded", "internal_faults": faults}, status_code=503)
        return JSONResponse({"status": "ready"})

    return Guard(Desk(app, monitor, model), api_key, max_body)


class Desk:
    """Answers `POST /act`, and hands everything else on.

    A decision takes a fraction of a millisecond and is made at once; another thread would cost as much again.
    While decisions are slow, and until they have been seen to be quick, they are made in a thread, so that
    health checks do not wait for them.

    Args:
        app: what answers the other paths.
        monitor: what decides.
        model: what it told of itself.
    """

    def __init__(self, app: ASGIApp, monitor: Monitor, model: ModelReply) -> None:
        self._app = app
        self._monitor = monitor
        self._model = model
        self._thread = ThreadPoolExecutor(1, "decisions")
        self._quick = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request."""
        if scope["type"] != "http" or scope["method"] != "POST" or scope["path"] != "/act":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        try:
            content = await _body(receive)
        except BodyTooLargeError as error:
            status, answer = _problem(413, [([], str(error), "too_large")])
        else:
            if self._quick >= _QUICK_ENOUGH:
                status, answer = self._decide(content, started)
            else:
                loop = asyncio.get_running_loop()
                status, answer = await loop.run_in_executor(self._thread, self._decide, content, started)
        await _reply(scope, send, status, answer)

    def _decide(self, content: bytes, started: float) -> Answer:
        begun = time.perf_counter()
        answer = _act(self._monitor, self._model, content, started)
        self._quick = self._quick + 1 if time.perf_counter() - begun < _QUICK else 0
        return answer


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


def _act(monitor: Monitor, model: ModelReply, content: bytes, started: float) -> Answer:
    """Answers a request's body."""
    try:
        asked = ActRequest.model_validate_json(content)
    except ValidationError as error:
        return _unprocessable([(list(item["loc"]), item["msg"], item["type"]) for item in error.errors()])
    if len(asked.observation) != model.observation_size:
        message = f"must have {model.observation_size} numbers, got {len(asked.observation)}"
        return _unprocessable([(["observation"], message, "wrong_length")])
    try:
        memory = None if asked.memory is None else memory_from_json(asked.memory.model_dump())
    except ValueError as error:
        return _unprocessable([(["memory"], str(error), "wrong_memory")])
    try:
        decision = monitor.decide(asked.observation, asked.hazards, memory)
        seconds = time.perf_counter() - started
        reply = reply_of(decision, asked.request, model.model, model.gate, seconds)
    except Exception as error:  # noqa: BLE001 - counted and logged; the client has a fallback of its own
        monitor.faults.note(type(error).__name__, "the decision could not be told", error)
        return _problem(500, [([], "internal error", "internal")])
    return 200, reply.model_dump_json().encode()


def _act_schema(model: ModelReply) -> dict[str, Any]:
    """The request's JSON schema, with the length that this bundle's observations have."""
    schema = ActRequest.model_json_schema()
    size = model.observation_size
    schema["properties"]["observation"] |= {"minItems": size, "maxItems": size}
    return schema


def _unprocessable(errors: list[tuple[list[str | int], str, str]]) -> Answer:
    return _problem(422, errors)


def _problem(status: int, errors: list[tuple[list[str | int], str, str]]) -> Answer:
    """An error in FastAPI's form; the input is left out, for it may be NaN or very long."""
    detail = [
        {"loc": ["body", *where], "msg": message, "type": kind}
        for where, message, kind in errors[:_MAX_ERRORS]
    ]
    return status, json.dumps({"detail": detail}).encode()
