"""`POST /act`: the monitor's decision, or a 422 that names the field; never NaN."""

from __future__ import annotations

import dataclasses
import json
import time

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic_core import to_json

from decision import MEMORY, MOST_OPEN, PLAN_STEPS, Decision, Faults, Mode, OpenedBy, Origin, pack, unpack
from filter import Robot
from guide import DEFAULT_STRENGTH
from monitor import Monitor
from server.alarms import RULES
from server.app import Lifecycle, create_app
from server.keys import Keys
from server.live import Hub
from server.operation import Operation
from server.schema import ActReply, decision_of, reply_of

MANY_FAULTS = int(RULES["faults"].limit) + 1
"""So many internal faults within a minute degrade the service."""


def same(value: object, other: object) -> bool:
    """Bit for bit, NaN is NaN."""
    return type(value) is type(other) and np.array_equal(value, other, equal_nan=isinstance(value, float))


def assert_same(decision: Decision, other: Decision) -> None:
    for field in dataclasses.fields(Decision):
        one, two = getattr(decision, field.name), getattr(other, field.name)
        if field.name == "memory":
            one, two = one.copy(), two.copy()
            one["seal"] = two["seal"] = 0  # the service's own
        if isinstance(one, np.ndarray | np.void):
            assert one.tobytes() == two.tobytes(), field.name
        else:
            assert same(one, two), field.name


def test_the_reply_is_the_monitors_decision(app, monitor, observation) -> None:
    memory = None
    for given_hazards in (None, [[0.45, 0.0], [-1.0, 2.0]], [[0.3, 0.1]]):
        body = {"observation": observation, "request": 7}
        if given_hazards is not None:
            body["hazards"] = given_hazards
        if memory is not None:
            body["memory"] = memory
        reply = app.post("/act", json=body).json()
        decision = monitor.decide(observation, given_hazards, None if memory is None else unpack(memory))
        assert_same(decision_of(ActReply.model_validate_json(json.dumps(reply))), decision)
        assert reply["gate_open"] is True
        assert (reply["request"], reply["gate"], reply["model"]) == (7, "always", monitor.bundle.id)
        assert 0.0 < reply["seconds"] < 60.0
        memory = reply["memory"]


def decisions() -> st.SearchStrategy[Decision]:
    """Decisions of every shape, among them some that know nothing."""
    action = arrays(np.float64, 2, elements=st.floats(-1.0, 1.0))
    numbers = st.floats(-1e9, 1e9) | st.just(float("nan"))

    def memory(side: int, guided: int, opened: int, plan: list[np.ndarray] | None) -> np.void:
        made = np.zeros(1, MEMORY)
        made["side"], made["guided"], made["open"] = side, guided, opened
        if plan is not None:
            made["planned"], made["left"] = True, len(plan)
            made["plan"][0, : len(plan)] = np.reshape(plan, (-1, 2))
        return made[0]

    return st.builds(
        Decision,
        action=action,
        nominal_action=action | st.just(np.full(2, np.nan)),
        mode=st.sampled_from(Mode),
        origin=st.none() | st.sampled_from(Origin),
        certified=st.booleans(),
        barrier=numbers,
        hazard=st.none() | st.integers(0, 1000),
        reason=st.none() | st.text(),
        risk=numbers,
        threshold=numbers,
        opened_by=st.none() | st.sampled_from(OpenedBy),
        novelty=numbers,
        suspect=st.none() | st.text(),
        memory=st.builds(
            memory,
            st.integers(-127, 127),
            st.integers(-1, 1),
            st.integers(0, MOST_OPEN),
            st.none() | st.lists(action, max_size=PLAN_STEPS),
        ),
    )


@given(decision=decisions())
def test_a_decision_comes_back_from_the_wire_as_it_was(decision: Decision) -> None:
    text = to_json(reply_of(decision, pack(decision.memory.tobytes()), 3, "model", "risk", 0.001))
    json.loads(text, parse_constant=pytest.fail)
    assert_same(decision_of(ActReply.model_validate_json(text)), decision)


def test_every_field_of_a_decision_is_on_the_wire() -> None:
    assert {field.name for field in dataclasses.fields(Decision)} <= set(ActReply.model_fields)


NUMBERS = "[" + ", ".join(["0.5"] * 59) + ", {}]"


@pytest.mark.parametrize(
    ("body", "where"),
    [
        (b"", ["body"]),
        (b"   ", ["body"]),
        (b"\xff\xfe", ["body"]),
        (b"[]", ["body"]),
        (b"null", ["body"]),
        (b"{}", ["body", "observation"]),
        (b'{"observation": null}', ["body", "observation"]),
        (b'{"observation": []}', ["body", "observation"]),
        (b'{"observation": 3}', ["body", "observation"]),
        (b'{"observation": {"0": 1}}', ["body", "observation"]),
        (json.dumps({"observation": [0.5] * 59}).encode(), ["body", "observation"]),
        (json.dumps({"observation": [0.5] * 61}).encode(), ["body", "observation"]),
        *(
            (f'{{"observation": {NUMBERS.format(bad)}}}'.encode(), ["body", "observation", 59])
            for bad in (
                "NaN",
                "Infinity",
                "-Infinity",
                "1e999",
                "-1e999",
                '"1.0"',
                "true",
                "null",
                "[1]",
                "9" * 400,
            )
        ),
        (f'{{"observation": {NUMBERS.format(1)}, "surprise": 1}}'.encode(), ["body", "surprise"]),
        (f'{{"observation": {NUMBERS.format(1)}, "hazards": [[1]]}}'.encode(), ["body", "hazards", 0]),
        (f'{{"observation": {NUMBERS.format(1)}, "hazards": [[1, 2, 3]]}}'.encode(), ["body", "hazards", 0]),
        (
            f'{{"observation": {NUMBERS.format(1)}, "hazards": [[1, NaN]]}}'.encode(),
            ["body", "hazards", 0, 1],
        ),
        (f'{{"observation": {NUMBERS.format(1)}, "hazards": 1}}'.encode(), ["body", "hazards"]),
        *(
            (f'{{"observation": {NUMBERS.format(1)}, "memory": {memory}}}'.encode(), ["body", *where])
            for memory, where in (
                ("3", ["memory"]),
                ("{}", ["memory"]),
                ('["x"]', ["memory"]),
                (f'"{"x" * 5000}"', ["memory"]),
            )
        ),
        (f'{{"observation": {NUMBERS.format(1)}, "request": -1}}'.encode(), ["body", "request"]),
        (f'{{"observation": {NUMBERS.format(1)}, "request": 1.5}}'.encode(), ["body", "request"]),
    ],
)
def test_what_cannot_be_decided_about_is_422_and_named(app, strict_json, body, where) -> None:
    reply = app.post("/act", content=body, headers={"content-type": "application/json"})
    assert reply.status_code == 422
    assert strict_json(reply.text)["detail"][0]["loc"] == where


def test_finite_nonsense_gets_the_fallback(app, strict_json, observation, sealed) -> None:
    body = {"observation": [1e300, *observation[1:]]}
    content = strict_json(app.post("/act", json=body).text)
    assert content["mode"] == "fallback"
    assert "observation[0]" in content["reason"]
    assert content["action"] == [0.0, 0.0]
    # A robot that has a plan goes on with it.
    body["memory"] = sealed([[0.05, -1.0], [0.03, 0.0]])
    content = strict_json(app.post("/act", json=body).text)
    assert (content["mode"], content["origin"]) == ("fallback", "plan")
    assert content["action"] == [0.05, -1.0]
    assert content["plan"] == [[0.03, 0.0]]


class Told(Monitor):
    """A monitor that decides what a test says."""

    def __init__(self, monitor: Monitor, **changes: object) -> None:
        self.__dict__ |= monitor.__dict__ | {"faults": Faults()}
        self.changes = changes

    def decide_lost(self, observation, hazards, memory, lost) -> Decision:
        return dataclasses.replace(super().decide_lost(observation, hazards, memory, lost), **self.changes)


def test_numbers_that_are_none_leave_as_null(monitor, strict_json, observation) -> None:
    unknown = Told(
        monitor, nominal_action=np.array([np.nan, np.inf]), risk=float("nan"), barrier=float("inf")
    )
    reply = TestClient(create_app(unknown)).post("/act", json={"observation": observation})
    content = strict_json(reply.text)
    assert content["nominal_action"] is content["risk"] is content["barrier"] is None
    assert np.isfinite(content["action"]).all()


def test_an_action_that_is_no_number_never_leaves_and_the_service_degrades(
    monitor, observation, caplog
) -> None:
    broken = Told(monitor, action=np.array([np.nan, 0.0]))
    app = TestClient(create_app(broken))
    for k in range(MANY_FAULTS):
        assert app.get("/readyz").status_code == 200, k
        assert app.post("/act", json={"observation": observation}).status_code == 500
    reply = app.get("/readyz")
    assert reply.status_code == 503
    assert (reply.json()["status"], reply.json()["why"]) == ("degraded", "alarm faults")
    assert app.get("/healthz").status_code == 200
    assert len(caplog.records) == 1


def test_an_observer_that_fails_costs_no_answer_and_no_other_observer_its_own(
    monitor, observation, monkeypatch, caplog
) -> None:
    """It is counted, logged once, and no reason to send robots elsewhere."""

    def broken(*_: object) -> None:
        raise AttributeError("a programming error")

    told, heard = Told(monitor), []
    operation = Operation(told)
    monkeypatch.setattr(operation.tally, "answered", broken)
    monkeypatch.setattr(Hub, "answered", lambda hub, answered: heard.append(answered.status))
    app = TestClient(create_app(told, operation=operation))
    for _ in range(MANY_FAULTS):
        assert app.post("/act", json={"observation": observation}).status_code == 200
    assert heard == [200] * MANY_FAULTS
    assert told.faults.counts == {"observer Tally": MANY_FAULTS}
    assert "a programming error" in caplog.text
    assert len(caplog.records) == 1
    assert app.get("/readyz").status_code == 200
    assert f'lagnet_faults_total{{kind="observer Tally"}} {MANY_FAULTS:.1f}' in app.get("/metrics").text


def test_faults_inside_the_monitor_degrade_the_service_and_bad_input_does_not(
    monitor, observation, monkeypatch
) -> None:
    told = Told(monitor)
    app = TestClient(create_app(told))
    for _ in range(3 * MANY_FAULTS):
        content = app.post("/act", json={"observation": [1e300, *observation[1:]]}).json()
        assert content["mode"] == "fallback"
    assert app.get("/readyz").status_code == 200

    def broken(*_: object) -> None:
        raise AttributeError("a programming error")

    monkeypatch.setattr(told, "_networks", broken)
    for _ in range(MANY_FAULTS):
        content = app.post("/act", json={"observation": observation}).json()
        assert (content["mode"], content["action"]) == ("fallback", [0.0, 0.0])
    assert app.get("/readyz").status_code == 503
    # They are forgotten after a minute.
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 61.0)
    assert app.get("/readyz").status_code == 200


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    observation=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=60, max_size=60) | JSON,
    hazards=st.lists(st.lists(st.floats(-10, 10), min_size=2, max_size=2), max_size=12) | JSON,
    memory=st.none() | JSON,
)
def test_whatever_comes_is_decided_or_refused_in_strict_json(
    app, strict_json, observation, hazards, memory
) -> None:
    body = json.dumps({"observation": observation, "hazards": hazards, "memory": memory})
    reply = app.post("/act", content=body)
    assert reply.status_code in (200, 422)
    content = strict_json(reply.text)
    if reply.status_code == 200:
        assert all(abs(value) <= 1.0 for value in content["action"])
        assert content["mode"] != "nominal" or content["action"] == content["nominal_action"]


def test_the_memory_of_a_reply_is_taken_back(app, observation) -> None:
    memory = app.post("/act", json={"observation": observation}).json()["memory"]
    again = app.post("/act", json={"observation": observation, "memory": memory})
    assert (again.status_code, again.json()["reason"]) == (200, None)


@pytest.mark.parametrize("stated", [True, False])
def test_a_body_above_the_limit_is_413(monitor, stated) -> None:
    app = TestClient(create_app(monitor, max_body=1000))
    content = b"x" * 1001 if stated else (b"x" * 100 for _ in range(11))
    reply = app.post("/act", content=content)
    assert reply.status_code == 413
    assert "1000 bytes" in reply.json()["detail"][0]["msg"]


def test_a_stated_length_of_any_size_is_413(app) -> None:
    for digits in (10, 5000):
        assert app.post("/act", content=b"{}", headers={"content-length": "9" * digits}).status_code == 413


def test_the_key_is_asked_for_everywhere_but_at_the_health_checks(monitor, observation) -> None:
    app = TestClient(create_app(monitor, keys=Keys(act="secret")))
    body = {"observation": observation}
    for headers in ({}, {"authorization": "Bearer wrong"}, {"authorization": "secret"}, {"x-api-key": ""}):
        assert app.post("/act", json=body, headers=headers).status_code == 401
        for path in ("/model", "/openapi.json", "/act/", "/nowhere"):
            assert app.get(path, headers=headers).status_code == 401
    for headers in (
        {"authorization": "Bearer secret"},
        {"authorization": "bearer secret"},
        {"x-api-key": "secret"},
    ):
        assert app.post("/act", json=body, headers=headers).status_code == 200
    assert app.get("/healthz").status_code == app.get("/readyz").status_code == 200


def test_while_draining_it_is_not_ready_but_answers(monitor, observation) -> None:
    lifecycle = Lifecycle()
    app = TestClient(create_app(monitor, lifecycle))
    assert app.get("/readyz").status_code == 200
    lifecycle.draining = True
    assert app.get("/readyz").status_code == 503
    assert app.get("/healthz").status_code == 200
    assert app.post("/act", json={"observation": observation}).status_code == 200


def test_the_model_is_told(app, monitor) -> None:
    content = app.get("/model").json()
    manifest = monitor.bundle.manifest
    assert content["model"] == monitor.bundle.id
    assert content["sha256"] == manifest.sha256
    assert [block["name"] for block in content["observation_layout"]][:2] == ["accelerometer", "velocimeter"]
    assert (content["gate"], content["threshold"]) == ("always", manifest.threshold)
    assert content["threshold_source"] == manifest.threshold_source
    assert content["guide"] == DEFAULT_STRENGTH
    assert content["robot"] == Robot()._asdict()
    assert (content["action_low"], content["action_high"]) == ([-1.0, -1.0], [1.0, 1.0])


def test_the_schema_tells_the_length_of_an_observation(app) -> None:
    operation = app.get("/openapi.json").json()["paths"]["/act"]["post"]
    schema = operation["requestBody"]["content"]["application/json"]["schema"]
    assert schema["properties"]["observation"]["minItems"] == 60
    reply = app.get("/openapi.json").json()["components"]["schemas"]["ActReply"]
    assert {"action", "origin", "opened_by", "memory", "request"} <= set(reply["required"])
