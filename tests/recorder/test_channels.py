"""The channels: what Foxglove can plot, and what replay needs."""

from __future__ import annotations

import json
from typing import Any

import pytest

from recorder.channels import DECISION, OBSERVATION, REPLY, REQUEST, encoded, schemas
from recorder.exchange import Exchange

SIMPLE = {"number": (int, float), "integer": (int,), "string": (str,), "boolean": (bool,)}


def check(schema: dict[str, Any]) -> None:
    """Foxglove's parser throws at whatever else (mcap-support, parseJsonSchema)."""
    assert schema["type"] == "object"
    for field in schema["properties"].values():
        assert "oneOf" not in field
        each = field["items"] if field["type"] == "array" else field
        assert each["type"] in (*SIMPLE, "object")
        if each["type"] == "object":
            check(each)


def conforms(value: Any, schema: dict[str, Any]) -> bool:
    kind = schema["type"]
    if kind == "object":
        known = schema["properties"]
        return all(name in known and conforms(each, known[name]) for name, each in value.items())
    if kind == "array":
        return isinstance(value, list) and all(conforms(each, schema["items"]) for each in value)
    return isinstance(value, SIMPLE[kind]) and (kind == "boolean") == isinstance(value, bool)


def no_constant(name: str) -> Any:
    raise AssertionError(f"{name} is no JSON")


def read(entries: list[tuple[str, bytes]], topic: str) -> list[Any]:
    return [json.loads(data, parse_constant=no_constant) for where, data in entries if where == topic]


def test_foxglove_reads_every_schema(observation_layout) -> None:
    made = schemas(observation_layout)
    assert set(made) == {REQUEST, REPLY, OBSERVATION, DECISION}
    for schema in made.values():
        check(json.loads(encoded(schema)))


def test_the_bodies_are_kept_byte_for_byte_and_the_plots_have_what_they_say(
    scribe, exchange, observation_layout
) -> None:
    one = exchange(7)
    entries, incident = scribe.entries(one)
    assert incident is None
    assert dict(entries)[REQUEST] == one.request
    assert dict(entries)[REPLY] == one.reply
    [seen], [told] = read(entries, OBSERVATION), read(entries, DECISION)
    numbers = json.loads(one.request)["observation"]
    for block in observation_layout:
        assert seen[block["name"]] == numbers[block["start"] : block["start"] + block["size"]]
    assert (told["robot"], told["risk"], told["action"], told["plan_left"]) == (1, 0.125, [0.5, -0.25], 1)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mode": "filtered", "origin": "barrier", "opened_by": "risk", "hazard": 3, "gate_open": True},
        {"opened_by": "novelty", "novelty": 3.5, "suspect": "gyro"},
        {
            "mode": "fallback",
            "risk": None,
            "novelty": None,
            "barrier": None,
            "nominal_action": None,
            "reason": "broken",
        },
        {"memory": {"side": 0, "guided": 0, "open": 0, "plan": None}},
    ],
)
def test_what_is_plotted_is_what_its_schema_says(scribe, exchange, observation_layout, changes) -> None:
    made = schemas(observation_layout)
    entries, _ = scribe.entries(exchange(1, **changes))
    for topic in (OBSERVATION, DECISION):
        for message in read(entries, topic):
            assert conforms(message, made[topic]), message


def test_given_hazards_are_places(scribe, exchange, observation_layout) -> None:
    one = exchange(1)
    request = json.loads(one.request) | {"hazards": [[1.0, 2.0], [3.0, 4.0]]}
    entries, _ = scribe.entries(one._replace(request=json.dumps(request).encode()))
    [seen] = read(entries, OBSERVATION)
    assert seen["hazards"] == [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}]
    assert conforms(seen, schemas(observation_layout)[OBSERVATION])


def test_each_robot_of_a_batch_has_its_messages_and_keeps_its_number(scribe, exchange, reply) -> None:
    one = exchange(1)
    asked = json.loads(one.request)
    refused = {"detail": [{"loc": ["body"], "msg": "no", "type": "wrong"}]}
    robots = [asked, {"anything": [None]}, asked | {"request": 9}]
    replies = [reply(asked), refused, reply(robots[2], mode="fallback", reason="lost")]
    batch = one._replace(
        request=json.dumps({"robots": robots}).encode(), reply=json.dumps({"replies": replies}).encode()
    )
    entries, incident = scribe.entries(batch)
    assert [told["robot"] for told in read(entries, DECISION)] == [1, 2]
    assert [seen["request"] for seen in read(entries, OBSERVATION)] == [1, 9]
    assert incident == "robot 2: lost"
    # Another connection is another robot, the same ones are the same.
    assert [told["robot"] for told in read(scribe.entries(exchange(2, port=5))[0], DECISION)] == [3]
    assert [told["robot"] for told in read(scribe.entries(batch)[0], DECISION)] == [1, 2]


@pytest.mark.parametrize(
    "request_body", [b'{"observation": [1.0], "request": 3}', b'{"robots": [1]}', b"{", b"[]"]
)
def test_a_reply_that_tells_no_decision_is_kept_and_is_an_incident(
    scribe, observation_layout, request_body: bytes
) -> None:
    body = b'{"detail": [{"loc": ["body"], "msg": "internal error", "type": "internal"}]}'
    one = Exchange(1, 5, 6, None, 500, request_body, body)
    entries, incident = scribe.entries(one)
    assert entries[:2] == [(REQUEST, request_body), (REPLY, body)]
    [told] = read(entries, DECISION)
    assert told["fault"] == 500
    assert "500" in told["reason"]
    assert incident is not None
    assert conforms(told, schemas(observation_layout)[DECISION])
