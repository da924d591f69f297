"""`POST /act`: the monitor's decision, or a 422 that names the field; never NaN."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from filter import FilterMemory
from monitor import Decision
from server import create_app
from server.app import Lifecycle


def test_the_reply_is_the_monitors_decision(app, monitor, observation) -> None:
    hazards = [[0.45, 0.0], [-1.0, 2.0]]
    for given_hazards in (None, hazards):
        body = {"observation": observation} | ({} if given_hazards is None else {"hazards": given_hazards})
        reply = app.post("/act", json=body).json()
        decision = monitor.decide(observation, given_hazards)
        assert reply["action"] == decision.action.tolist()
        assert reply["nominal_action"] == decision.nominal_action.tolist()
        for name in ("risk", "threshold", "mode", "barrier", "hazard", "row", "reason", "gate_open"):
            assert reply[name] == getattr(decision, name)
        assert reply["model"] == monitor.bundle.id
        assert 0.0 < reply["seconds"] < 60.0


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
        (f'{{"observation": {NUMBERS.format(1)}, "memory": {{"x": [1]}}}}'.encode(), ["body", "memory"]),
        (
            f'{{"observation": {NUMBERS.format(1)}, "memory": {{"side": [NaN]}}}}'.encode(),
            ["body", "memory", "side", 0],
        ),
    ],
)
def test_what_cannot_be_decided_about_is_422_and_named(app, strict_json, body, where) -> None:
    reply = app.post("/act", content=body, headers={"content-type": "application/json"})
    assert reply.status_code == 422
    assert strict_json(reply.text)["detail"][0]["loc"] == where


def test_finite_nonsense_gets_the_fallback(app, strict_json, observation) -> None:
    reply = app.post("/act", json={"observation": [1e300, *observation[1:]]})
    assert reply.status_code == 200
    content = strict_json(reply.text)
    assert content["mode"] == "fallback"
    assert content["reason"] == "observation[0] is 1e+300"
    assert content["action"] == [0.0, 0.0]


def test_numbers_that_are_none_leave_as_null(monitor, strict_json, observation) -> None:
    class Unknowing:
        bundle, gate, threshold = monitor.bundle, monitor.gate, monitor.threshold

        def decide(self, observation, hazards, memory) -> Decision:
            nothing = float("nan")
            pair = np.array([nothing, np.inf])
            return Decision(
                np.zeros(2), pair, nothing, 0.5, "fallback", float("inf"), None, None, "broken", True, None
            )

    content = strict_json(
        TestClient(create_app(Unknowing())).post("/act", json={"observation": observation}).text
    )
    assert content["nominal_action"] is content["risk"] is content["barrier"] is content["memory"] is None
    assert content["action"] == [0.0, 0.0]


def test_a_decision_whose_action_is_no_number_never_leaves(monitor, observation) -> None:
    class Broken:
        bundle, gate, threshold = monitor.bundle, monitor.gate, monitor.threshold

        def decide(self, observation, hazards, memory) -> Decision:
            pair = np.array([np.nan, 0.0])
            return Decision(pair, pair, 0.0, 0.5, "nominal", 0.0, None, None, None, True, None)

    reply = TestClient(create_app(Broken()), raise_server_exceptions=False).post(
        "/act", json={"observation": observation}
    )
    assert reply.status_code == 500


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
    assert set(memory) == set(FilterMemory.__dataclass_fields__)
    assert app.post("/act", json={"observation": observation, "memory": memory}).status_code == 200


@pytest.mark.parametrize("stated", [True, False])
def test_a_body_above_the_limit_is_413(monitor, stated) -> None:
    app = TestClient(create_app(monitor, max_body=1000))
    content = b"x" * 1001 if stated else (b"x" * 100 for _ in range(11))
    reply = app.post("/act", content=content)
    assert reply.status_code == 413
    assert "1000 bytes" in reply.json()["detail"][0]["msg"]


def test_the_key_is_asked_for_everywhere_but_at_the_health_checks(monitor, observation) -> None:
    app = TestClient(create_app(monitor, api_key="secret"))
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


def test_the_schema_tells_the_length_of_an_observation(app) -> None:
    operation = app.get("/openapi.json").json()["paths"]["/act"]["post"]
    schema = operation["requestBody"]["content"]["application/json"]["schema"]
    assert schema["properties"]["observation"]["minItems"] == 60
    assert "action" in json.dumps(app.get("/openapi.json").json()["components"]["schemas"]["ActReply"])
