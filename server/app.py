"""The HTTP service: `POST /act`, `/model`, `/healthz`, `/readyz`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.routing import Route
from starlette.types import ASGIApp

from decision import memory_from_json
from monitor import Monitor
from server.guard import BodyTooLargeError, Guard
from server.schema import ActReply, ActRequest, ModelReply, reply_of

MAX_BODY = 65536
"""Most bytes of a request's body: 60 numbers and a thousand hazards fit."""
MANY_FAULTS = 5
"""Internal faults within a minute from which on the service is not ready: a robot may live with one."""
_MAX_ERRORS = 8


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

    # The endpoint reads and writes the body itself, through pydantic's own JSON parser and serialiser: half
    # the time of a typed endpoint, and its errors name the field without repeating the input, which may be
    # NaN.
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
    async def act(request: Request) -> Response:
        started = time.perf_counter()
        try:
            content = await request.body()
        except BodyTooLargeError as error:
            return _problem(413, [([], str(error), "too_large")])
        return _act(monitor, model, content, started)

    # Found first: the same function without FastAPI's handling of parameters, of which it has none. The
    # declaration above documents it.
    app.router.routes.insert(0, Route("/act", act, methods=["POST"]))

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

    app.add_middleware(Guard, api_key=api_key, max_body=max_body)
    return app


def _act(monitor: Monitor, model: ModelReply, content: bytes, started: float) -> Response:
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
    return Response(reply.model_dump_json(), media_type="application/json")


def _act_schema(model: ModelReply) -> dict[str, Any]:
    """The request's JSON schema, with the length that this bundle's observations have."""
    schema = ActRequest.model_json_schema()
    size = model.observation_size
    schema["properties"]["observation"] |= {"minItems": size, "maxItems": size}
    return schema


def _unprocessable(errors: list[tuple[list[str | int], str, str]]) -> JSONResponse:
    return _problem(422, errors)


def _problem(status: int, errors: list[tuple[list[str | int], str, str]]) -> JSONResponse:
    """An error in FastAPI's form; the input is left out, for it may be NaN or very long."""
    detail = [
        {"loc": ["body", *where], "msg": message, "type": kind}
        for where, message, kind in errors[:_MAX_ERRORS]
    ]
    return JSONResponse({"detail": detail}, status_code=status)
