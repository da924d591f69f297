"""What an operator asks and says over HTTP: metrics, alarms, hold, another bundle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.routing import Match

from server import metrics
from server.change import BusyError, ChangeError, Changer
from server.keys import ALARMS, HOLD, MODEL, RESUME
from server.operation import HeldError, Operation
from server.schema import ModelReply
from server.states import TransitionError

_REFUSED: dict[int | str, dict[str, Any]] = {
    400: {"description": "the body is no text"},
    401: {"description": "no valid key"},
    403: {"description": "not the admin key, or another site's page"},
    409: {"description": "not possible now; says why"},
}
_MOST_ERRORS = 8

Text = Annotated[str, Field(strict=True, min_length=1, max_length=200)]


class HoldRequest(BaseModel):
    """The body of `POST /hold`.

    Attributes:
        why: why, for whoever reads of it later.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    why: Text = "an operator said so"


class ChangeRequest(BaseModel):
    """The body of `POST /model`.

    Attributes:
        bundle: the bundle's path below the folder of --bundles.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bundle: Text


class StateReply(BaseModel):
    """Where the service stands.

    Attributes:
        state: starting, ready, degraded, hold, draining or stopped.
        why: why, in words.
    """

    state: str
    why: str


class AlarmReply(BaseModel):
    """How an alarm stands.

    Attributes:
        name: its name.
        state: clear, pending, active or latched.
        since: since when [s since 1970].
        value: the last value; null: not known, or beyond all bounds.
        limit: it is set above this.
        acknowledged: whether somebody has seen it since it was set.
        cause: what set it; null while it is clear.
        chattering: whether it is set and cleared again and again.
        effect: tell, degrade or hold.
        about: what its value is.
    """

    name: str
    state: str
    since: float
    value: float | None
    limit: float
    acknowledged: bool
    cause: str | None
    chattering: bool
    effect: str
    about: str


def add_console(
    app: FastAPI, operation: Operation, changer: Changer | None, refusals: Mapping[int, int]
) -> None:
    """Adds the paths.

    Args:
        app: to which.
        operation: the service's.
        changer: changes the bundle; None: nobody does.
        refusals: status → requests that were refused before they came to a decision.
    """
    _add_views(app, operation, refusals)
    _add_commands(app, operation)
    _add_change(app, changer)

    @app.exception_handler(RequestValidationError)
    async def refused(request: Request, error: RequestValidationError) -> JSONResponse:
        # The input is left out: it may be NaN, which no JSON has, or very long.
        detail = [
            {"loc": list(item["loc"]), "msg": item["msg"], "type": item["type"]}
            for item in error.errors()[:_MOST_ERRORS]
        ]
        return JSONResponse({"detail": detail}, 422)

    @app.exception_handler(405)
    async def not_allowed(request: Request, error: HTTPException) -> JSONResponse:
        # Of a path with two routes, FastAPI names the methods of the first alone.
        fitting = [route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE]
        methods = sorted({method for route in fitting for method in getattr(route, "methods", ())})
        return JSONResponse({"detail": error.detail}, 405, {"allow": ", ".join(methods)})


def _add_views(app: FastAPI, operation: Operation, refusals: Mapping[int, int]) -> None:
    write = metrics.exposition(operation, refusals)

    # Made in the event loop: a thread would hold decisions up for longer than the millisecond it takes.
    @app.get("/metrics", response_class=Response)
    async def metrics_() -> Response:
        operation.tick()
        return Response(write(), media_type=metrics.CONTENT_TYPE)

    @app.get(ALARMS, response_model=list[AlarmReply])
    async def alarms() -> Any:
        operation.tick()
        return operation.snapshot()["alarms"]

    @app.post(
        ALARMS + "/{name}/acknowledge",
        response_model=list[AlarmReply],
        responses={404: {"description": "no such alarm"}},
    )
    async def acknowledge(name: str) -> Any:
        if name not in operation.alarms.alarms:
            raise HTTPException(
                404, f"no alarm has this name; there are {', '.join(operation.alarms.alarms)}"
            )
        operation.acknowledge(name)
        return operation.snapshot()["alarms"]


def _add_commands(app: FastAPI, operation: Operation) -> None:
    def state() -> StateReply:
        return StateReply(state=operation.states.state, why=operation.states.why)

    @app.post(HOLD, response_model=StateReply, responses=_REFUSED)
    async def hold(asked: HoldRequest | None = None) -> StateReply:
        try:
            operation.hold((asked or HoldRequest()).why)
        except TransitionError as error:
            raise HTTPException(409, str(error)) from error
        return state()

    @app.post(RESUME, response_model=StateReply, responses=_REFUSED)
    async def resume() -> StateReply:
        operation.tick()
        try:
            operation.resume()
        except (TransitionError, HeldError) as error:
            raise HTTPException(409, str(error)) from error
        return state()


def _add_change(app: FastAPI, changer: Changer | None) -> None:
    @app.post(
        MODEL,
        response_model=ModelReply,
        responses=_REFUSED | {404: {"description": "the service has no other bundles"}},
    )
    async def change(asked: ChangeRequest) -> ModelReply:
        if changer is None or not changer.allows_names:
            raise HTTPException(404, "the service was started without --bundles: it has no other bundles")
        try:
            return await changer.to(asked.bundle)
        except BusyError as error:
            raise HTTPException(409, str(error)) from error
        except ChangeError as error:
            detail = [{"loc": ["body", "bundle"], "msg": str(error), "type": "bundle"}]
            raise HTTPException(422, detail) from error
