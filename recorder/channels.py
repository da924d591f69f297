"""What is written of an exchange: four channels of JSON.

`/request` and `/reply` are the bodies, byte for byte: from them a decision can be made again. `/observation`
and `/decision` are for plots, a message a robot. All messages of one exchange have its number as `sequence`.

Foxglove reads of JSON Schema what `_object`, `_list` and the constants below say, and shows no channel whose
schema says more: no union, no null, no list of lists. What is unknown is therefore left out of a message.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import from_json, to_json

from recorder.exchange import Exchange

REQUEST, REPLY, OBSERVATION, DECISION = "/request", "/reply", "/observation", "/decision"
TOPICS = (REQUEST, REPLY, OBSERVATION, DECISION)

_MOST_ROBOTS = 4096
"""So many robots are told apart; of more, the one that was heard of longest ago is forgotten."""
_TOLD = (
    "mode",
    "origin",
    "opened_by",
    "gate_open",
    "certified",
    "risk",
    "threshold",
    "barrier",
    "novelty",
    "suspect",
    "hazard",
    "action",
    "nominal_action",
    "reason",
    "request",
    "seconds",
)
"""The fields of a reply that `/decision` repeats."""

Schema = dict[str, Any]
Entries = list[tuple[str, bytes]]
"""Topic and message."""

_NUMBER: Schema = {"type": "number"}
_TEXT: Schema = {"type": "string"}
_FLAG: Schema = {"type": "boolean"}


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


def _list(of: Schema) -> Schema:
    return {"type": "array", "items": of}


def _of(schema: Schema, about: str) -> Schema:
    return schema | {"description": about}


_NUMBERS = _list(_NUMBER)
_PLACES = _list(_object(x=_NUMBER, y=_NUMBER))
_ROBOT = _of(_NUMBER, "counted as they came: one a connection, and one a place in a batch")
_DECISION = _object(
    robot=_ROBOT,
    mode=_of(_TEXT, "what became of the policy's action: nominal, guided, filtered, fallback"),
    origin=_of(_TEXT, "where another action came from"),
    opened_by=_of(_TEXT, "why the filter was active"),
    gate_open=_of(_FLAG, "whether the filter was active"),
    certified=_FLAG,
    risk=_of(_NUMBER, "λ"),
    threshold=_of(_NUMBER, "the gate `risk` opens above it"),
    barrier=_of(_NUMBER, "m"),
    novelty=_of(_NUMBER, "how far the observation is from what it should be; above 1 the gate opens"),
    suspect=_of(_TEXT, "the sensor that is the farthest from it"),
    hazard=_of(_NUMBER, "the nearest one's place in the list"),
    action=_of(_NUMBERS, "what was sent: thrust, turn"),
    nominal_action=_of(_NUMBERS, "the policy's: thrust, turn"),
    reason=_of(_TEXT, "of a fallback"),
    request=_of(_NUMBER, "the request's own number"),
    seconds=_of(_NUMBER, "how long the decision took, s"),
    plan_left=_of(_NUMBER, "how many actions of the certified plan are left"),
    fault=_of(_NUMBER, "the status of a reply that tells no decision"),
)
_RAW = _object(request=_of(_NUMBER, "the request's own number"))


def schemas(layout: list[Mapping[str, Any]]) -> dict[str, Schema]:
    """Topic → JSON schema.

    Args:
        layout: the blocks of the observation: name, start, size and unit of each.
    """
    blocks = {str(block["name"]): _of(_NUMBERS, str(block["unit"])) for block in layout}
    hazards = _of(_PLACES, "as given, in the body frame, m")
    observation = _object(**blocks, robot=_ROBOT, request=_NUMBER, hazards=hazards)
    return {REQUEST: _RAW, REPLY: _RAW, OBSERVATION: observation, DECISION: _DECISION}


class Scribe:
    """Writes exchanges down as messages.

    Args:
        layout: the blocks of the observation: name, start, size and unit of each.
    """

    def __init__(self, layout: list[Mapping[str, Any]]) -> None:
        self._blocks = [
            (str(block["name"]), slice(block["start"], block["start"] + block["size"])) for block in layout
        ]
        self._robots: dict[tuple[Any, int], int] = {}
        self._count = 0

    def entries(self, exchange: Exchange) -> tuple[Entries, str | None]:
        """An exchange's messages, and what of it is an incident: why a robot was sent the fallback."""
        entries: Entries = [(REQUEST, exchange.request), (REPLY, exchange.reply)]
        incident = None
        try:
            asked, replied = from_json(exchange.request), from_json(exchange.reply)
            rows = list(_robots(asked, replied))
        except (ValueError, TypeError, KeyError):
            # A request that could not be read, and its fault: the bodies say it all.
            rows = [(0, {}, {})]
        for place, question, answer in rows:
            robot = self._robot(exchange.client, place)
            if exchange.status != 200:
                told: dict[str, Any] = {"robot": robot, "fault": exchange.status}
                told |= {"reason": f"fault: the reply had status {exchange.status}"}
            else:
                told = {"robot": robot} | {
                    name: answer[name] for name in _TOLD if answer.get(name) is not None
                }
                told["plan_left"] = len(answer["plan"])
            if told.get("mode", "fallback") == "fallback":
                incident = incident or f"robot {robot}: {told.get('reason') or 'fallback'}"
            if question:
                entries.append((OBSERVATION, to_json(self._observed(robot, question))))
            entries.append((DECISION, to_json(told)))
        return entries, incident

    def _observed(self, robot: int, asked: Mapping[str, Any]) -> dict[str, Any]:
        numbers = asked["observation"]
        seen = {"robot": robot, "request": asked.get("request", 0)}
        seen |= {name: numbers[place] for name, place in self._blocks}
        if asked.get("hazards"):
            seen["hazards"] = [{"x": x, "y": y} for x, y in asked["hazards"]]
        return seen

    def _robot(self, client: Any, place: int) -> int:
        key = (tuple(client) if client else None, place)
        robot = self._robots.pop(key, None)
        if robot is None:
            self._count += 1
            robot = self._count
            if len(self._robots) >= _MOST_ROBOTS:
                del self._robots[next(iter(self._robots))]
        self._robots[key] = robot
        return robot


def _robots(asked: Any, replied: Any) -> Iterator[tuple[int, dict[str, Any], dict[str, Any]]]:
    """Place, request and reply of each robot about which there was to be a decision."""
    if "robots" not in asked:
        yield 0, asked, replied
    elif "replies" not in replied:
        yield 0, {}, {}
    else:
        for place, (question, answer) in enumerate(zip(asked["robots"], replied["replies"], strict=True)):
            if "mode" in answer:
                yield place, question, answer


def encoded(schema: Schema) -> bytes:
    """A schema as it is written."""
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema).encode()
