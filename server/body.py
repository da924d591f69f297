"""How requests are read and answers written: JSON or msgpack, and errors in FastAPI's form."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import msgpack
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json, to_json

from decision import Decision
from server.schema import ActRequest, ModelReply

_MAX_ERRORS = 8

Problem = tuple[list[str | int], str, str]
"""Where in the body, what is wrong, and its kind."""
Validated = TypeVar("Validated", bound=BaseModel)


class Answer(NamedTuple):
    """What is answered, and about whom was decided."""

    status: int
    body: bytes
    asked: Sequence[ActRequest] = ()
    """The requests that were decided about, in order."""
    decisions: Sequence[Decision] = ()
    """What was decided about each."""
    model: ModelReply | None = None
    """What the one who decided tells of itself."""
    begun: float = math.nan
    """When that began, on the clock of `time.perf_counter` [s]."""


class RefusedError(ValueError):
    """A request that cannot be decided about.

    Attributes:
        errors: what is wrong with it.
    """

    def __init__(self, errors: list[Problem]) -> None:
        super().__init__(errors)
        self.errors = errors


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


def validated(validate: Callable[[], Validated]) -> Validated:
    """What a validation gives.

    Raises:
        RefusedError: naming what is wrong.
    """
    try:
        return validate()
    except ValidationError as error:
        where = [(list(item["loc"]), item["msg"], item["type"]) for item in error.errors()]
        raise RefusedError(where) from error


def parsed(content: bytes) -> Any:
    """A body of JSON; raises RefusedError."""
    try:
        return from_json(content)
    except ValueError as error:
        raise RefusedError([([], f"Invalid JSON: {error}", "json_invalid")]) from error


def problem(status: int, errors: list[Problem], codec: Codec = JSON) -> Answer:
    """An error in FastAPI's form, and its status, which a frame does not have beside it."""
    return Answer(status, codec.write({"status": status, "detail": detail_of(errors)}))


def detail_of(errors: list[Problem]) -> list[dict[str, Any]]:
    """The input is left out: it may be NaN or very long."""
    return [
        {"loc": ["body", *where], "msg": message, "type": kind}
        for where, message, kind in errors[:_MAX_ERRORS]
    ]
