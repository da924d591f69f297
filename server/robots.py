"""`GET /robots` lists the robots that the service knows; `POST /robots/{name}/reset` ends a hold."""

from __future__ import annotations

import time
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Path
from pydantic import BaseModel

from server.freshness import Freshness, RobotState, Seen
from server.keeper import Keeper

RESET = "reset_robot"
"""The id of the operation that ends a hold, for links to it."""


class RobotsReply(BaseModel):
    """The reply of `GET /robots`.

    Attributes:
        robots: those that are known; whoever asked last comes last.
    """

    robots: list[Seen]


def robots_router(
    freshness: Freshness, keeper: Keeper, refusals: dict[int | str, dict[str, Any]]
) -> APIRouter:
    """The two paths.

    Args:
        freshness: who knows the robots.
        keeper: who remembers which of them had a sensor caught.
        refusals: the documented answers to requests without the right key.
    """
    router = APIRouter(responses=refusals)

    @router.get("/robots")
    async def robots() -> RobotsReply:
        return RobotsReply(robots=freshness.robots(time.perf_counter()))

    @router.post(
        "/robots/{name}/reset",
        operation_id=RESET,
        responses={404: {"description": "no robot of this name is known"}},
    )
    async def reset(name: Annotated[str, Path(pattern=r"^[A-Za-z0-9_.:-]{1,64}$")]) -> dict[str, str]:
        if not (freshness.reset(name) | keeper.forget(name)):
            raise HTTPException(404, "no robot of this name is known")
        return {"robot": name, "state": RobotState.FRESH}

    return router
