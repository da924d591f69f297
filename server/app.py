"""The HTTP service: decisions, what tells of itself, health checks, a page, what operators ask and say."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse
from starlette.types import ASGIApp

from filter import FilterConfig
from monitor import Monitor
from recorder import Recorder
from server.change import Changer
from server.console import add_console
from server.desk import Desk
from server.freshness import Freshness
from server.guard import Guard
from server.keeper import KEY_BYTES, Keeper
from server.keys import ACT, BATCH, Keys
from server.live import Hub
from server.observer import Observer, Recording
from server.operation import Operation
from server.robots import RESET, robots_router
from server.safety import Safety
from server.schema import MAX_ROBOTS, ActReply, ActRequest, BatchReply, ModelReply
from server.states import NOT_READY, State
from server.static import routes
from server.view import Views

MAX_BODY = 65536
"""Most bytes of a request's body: 60 numbers and a thousand hazards fit."""
BATCH_BODY = 16
"""The body of a batch may be so many times as large."""

_REFUSALS: dict[int | str, dict[str, Any]] = {
    401: {"description": "no valid key"},
    403: {"description": "a key for less than this, or another site's page"},
    413: {"description": "body too large"},
}
_ACT_LINKS: dict[int | str, dict[str, Any]] = {
    200: {"links": {"reset": {"operationId": RESET, "parameters": {"name": "$request.body#/robot"}}}}
}
_ERRORS: dict[int | str, dict[str, Any]] = _REFUSALS | {
    422: {"description": "names the field that is wrong"},
    500: {"description": "the decision could not be told"},
    503: {"description": "overloaded; Retry-After says when to try again"},
}


@dataclass
class Lifecycle:
    """Where the service stands.

    Attributes:
        draining: it is about to stop: /readyz says 503, requests are still answered.
        at_end: called once it accepts no more connections: they end what would go on for ever.
    """

    draining: bool = False
    at_end: list[Callable[[], None]] = field(default_factory=list)


def create_app(
    monitor: Monitor,
    lifecycle: Lifecycle | None = None,
    keys: Keys | None = None,
    max_body: int = MAX_BODY,
    recorder: Recorder | None = None,
    operation: Operation | None = None,
    changer: Changer | None = None,
    safety: Safety | None = None,
    freshness: Freshness | None = None,
    memory_key: bytes | None = None,
    filter_config: FilterConfig | None = None,
    around: Callable[[ASGIApp], ASGIApp] | None = None,
) -> Guard:
    """The service around one monitor that is loaded and warmed up.

    Args:
        monitor: what decides.
        lifecycle: shared with whoever stops the service.
        keys: those that every request but the health checks must carry one of; None asks for none.
        max_body: most bytes of a request's body; a batch's may be `BATCH_BODY` times as large.
        recorder: what records the decisions, if any does.
        operation: what an operator sees and says; by default one with the usual alarms.
        changer: changes the bundle; None: nobody does.
        safety: the limits within which it decides.
        freshness: shared with whoever looks for silent robots; by default one within `safety.freshness`.
        memory_key: seals the robots' memories, see `Keeper`; None: one made at random.
        filter_config: the filter's settings; None: the defaults.
        around: what stands between the guard and the service, if anything does.
    """
    state = lifecycle or Lifecycle()
    limits = safety or Safety()
    known = freshness or Freshness(limits.freshness, monitor.faults.note)
    watched = operation or Operation(monitor, recorder)
    duty = watched.duty
    model = duty.now.model
    # No /docs: its page loads scripts from other hosts. /openapi.json is there.
    app = FastAPI(
        title="Lagnet", description="What a watched robot policy does next.", docs_url=None, redoc_url=None
    )

    # These two document their paths; `Desk` answers them before FastAPI is asked, at a third of the cost, and
    # with errors that name the field without repeating the input, which may be NaN.
    @app.post(
        ACT,
        response_model=ActReply,
        responses=_ERRORS | _ACT_LINKS,
        openapi_extra=_body_of(_act_schema(model)),
    )
    async def act() -> None:
        raise NotImplementedError

    @app.post(
        BATCH, response_model=BatchReply, responses=_ERRORS, openapi_extra=_body_of(_batch_schema(model))
    )
    async def act_batch() -> None:
        raise NotImplementedError

    @app.get("/model", response_model=ModelReply)
    async def about() -> ModelReply:
        return duty.now.model

    @app.get("/healthz")
    async def healthz() -> dict[str, Any]:
        # A service that can no longer record is alive, and says so.
        told = {"status": "alive", "state": watched.states.state}
        return told | ({} if recorder is None else {"recording": recorder.status()})

    @app.get("/readyz", responses={503: {"description": "starting, degraded, draining or stopped"}})
    async def readyz() -> JSONResponse:
        if state.draining:
            watched.drain()
        status = watched.tick()
        told = {"why": watched.states.why} if status in (State.DEGRADED, State.HOLD) else {}
        return JSONResponse({"status": status} | told, 503 if status in NOT_READY else 200)

    facts = model.model_dump(include={"model", "task", "gate", "threshold", "guide"})
    facts["full_thrust"] = monitor.robot.force_limit
    hub = Hub(Views(monitor, filter_config or FilterConfig()), watched, facts)
    state.at_end.append(hub.close)
    app.router.routes.extend(routes(hub))
    observers: list[Observer] = [watched.tally, hub]
    if recorder is not None:
        observers.append(Recording(recorder, model))
    keeper = Keeper(memory_key or secrets.token_bytes(KEY_BYTES), monitor.faults)
    app.include_router(robots_router(known, keeper, _REFUSALS))
    desk: ASGIApp = Desk(app, duty, keeper, observers, limits, known)
    guard = Guard(
        desk if around is None else around(desk), keys or Keys(), max_body, {BATCH: BATCH_BODY * max_body}
    )
    add_console(app, watched, changer, guard.refusals)
    return guard


def _act_schema(model: ModelReply) -> dict[str, Any]:
    """The request's JSON schema, with the length that this bundle's observations have."""
    schema = ActRequest.model_json_schema()
    size = model.observation_size
    schema["properties"]["observation"] |= {"minItems": size, "maxItems": size}
    return schema


def _batch_schema(model: ModelReply) -> dict[str, Any]:
    robots = {"type": "array", "minItems": 1, "maxItems": MAX_ROBOTS, "items": _act_schema(model)}
    return {
        "type": "object",
        "properties": {"robots": robots},
        "required": ["robots"],
        "additionalProperties": False,
    }


def _body_of(schema: dict[str, Any]) -> dict[str, Any]:
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}
