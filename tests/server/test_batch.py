"""`POST /act/batch`: many robots in one request, each as if it had asked alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fastapi.testclient import TestClient

from monitor import Monitor
from pointgoal.lidar import encode
from server.app import create_app
from server.schema import MAX_ROBOTS

PLAN = [[-0.05, 0.25], [0.05, -1.0]]


def robots(count: int, memory: str | None = None) -> list[dict[str, object]]:
    """Robots of all kinds: with and without hazards that are given, with and without a memory."""
    rng = np.random.default_rng(5)
    made = []
    for k in range(count):
        observation = rng.uniform(-0.5, 0.5, 60)
        observation[3:6] = (0.6 * (-1) ** k, 0.0, 0.0)
        observation[12:] = 0.0
        observation[28:44] = encode(rng.uniform(-0.9, 0.9, (1, 1, 2)))[0]
        robot: dict[str, object] = {"observation": observation.tolist(), "request": 100 + k}
        if k % 3:
            robot["hazards"] = [[0.4, 0.02], [1.0, -1.0]][: k % 3]
        if k % 2:
            robot["memory"] = memory
        made.append(robot)
    return made


def alike(told: dict[str, object], alone: dict[str, object]) -> bool:
    """Whether two replies are the same but for the time taken and the last bits of float32."""
    for name in alone.keys() - {"seconds", "memory"}:
        if name in ("risk", "nominal_action", "action", "barrier"):
            same = np.allclose(np.array(told[name], float), np.array(alone[name], float), atol=1e-5)
        else:
            same = told[name] == alone[name]
        if not same:
            return False
    return told.keys() == alone.keys()


def test_each_robot_gets_what_it_would_alone(app, strict_json, sealed) -> None:
    asked = robots(12, sealed(PLAN, side=3, guided=1))
    reply = app.post("/act/batch", json={"robots": asked})
    assert reply.status_code == 200
    told = strict_json(reply.text)["replies"]
    alone = [app.post("/act", json=robot).json() for robot in asked]
    assert [one["request"] for one in told] == [robot["request"] for robot in asked]
    assert {"nominal", "filtered"} <= {one["mode"] for one in alone}
    # The lidar's hazards are counted after the robot's own, however many the others have.
    assert any(one["hazard"] is not None and one["hazard"] >= 3 for one in alone)
    for one, other in zip(told, alone, strict=True):
        assert alike(one, other), (one, other)


def test_the_batch_is_one_call_of_the_monitor(monitor, monkeypatch) -> None:
    counts = []
    decide_batch = Monitor.decide_batch

    def counted(self, observation, hazards=None, memory=None):
        counts.append(len(observation))
        return decide_batch(self, observation, hazards, memory)

    monkeypatch.setattr(Monitor, "decide_batch", counted)
    assert TestClient(create_app(monitor)).post("/act/batch", json={"robots": robots(7)}).status_code == 200
    assert counts == [7]


def row(number: str, **more: object) -> str:
    """A robot's request in which every number of the observation is the same text."""
    return (
        f'{{"observation": [{", ".join([number] * 60)}]'
        + "".join(
            f', "{name}": {value if isinstance(value, str) else json.dumps(value)}'
            for name, value in more.items()
        )
        + "}"
    )


FAULTS = [
    ("null", ["body"]),
    ("{}", ["body", "observation"]),
    ('{"observation": [1]}', ["body", "observation"]),
    (row("NaN"), ["body", "observation", 0]),
    (row("true"), ["body", "observation", 0]),
    (row("0", hazards="[[1e999, 0]]"), ["body", "hazards", 0, 0]),
    (row("0", memory=3), ["body", "memory"]),
    (row("0", surprise=1), ["body", "surprise"]),
]


def test_a_fault_in_one_row_is_that_robots_alone(app, strict_json) -> None:
    good = robots(3)
    rows = [json.dumps(good[0]), *(asked for asked, _ in FAULTS), json.dumps(good[1]), json.dumps(good[2])]
    reply = app.post("/act/batch", content=f'{{"robots": [{", ".join(rows)}]}}')
    assert reply.status_code == 200
    told = strict_json(reply.text)["replies"]
    alone = [app.post("/act", json=robot).json() for robot in good]
    for one, other in zip((told[0], *told[-2:]), alone, strict=True):
        assert alike(one, other)
    for (asked, where), one in zip(FAULTS, told[1:-2], strict=True):
        assert one["detail"][0]["loc"] == where
        # As it would be told alone.
        same = app.post("/act", content=asked).json()["detail"]
        assert [(fault["loc"], fault["type"]) for fault in same] == [
            (fault["loc"], fault["type"]) for fault in one["detail"]
        ]


def test_what_can_be_read_but_not_decided_is_that_robots_fallback(app, sealed) -> None:
    asked = robots(3)
    asked[1] = {"observation": [1e300] * 60, "memory": sealed(PLAN)}
    told = app.post("/act/batch", json={"robots": asked}).json()["replies"]
    assert told[1]["mode"] == "fallback"
    assert told[1]["action"] == PLAN[0]
    assert told[0]["reason"] is None
    assert told[2]["reason"] is None


def test_a_memory_with_a_wrong_seal_is_lost_to_that_robot_alone(app, sealed) -> None:
    asked = robots(3)
    asked[0]["memory"], asked[1]["memory"] = sealed(PLAN), sealed(PLAN, robot="another")
    told = app.post("/act/batch", json={"robots": asked}).json()["replies"]
    assert [one["reason"] for one in told] == [None, "the memory is not one that this service sent", None]
    assert told[1]["mode"] == "fallback"


def test_robots_that_are_all_refused_are_told_so(app) -> None:
    told = app.post("/act/batch", content=b'{"robots": [{}, 1]}').json()["replies"]
    assert [list(one) for one in told] == [["detail"], ["detail"]]


@pytest.mark.parametrize(
    ("body", "where"),
    [
        (b"", ["body"]),
        (b"{", ["body"]),
        (b"[]", ["body"]),
        (b"{}", ["body", "robots"]),
        (b'{"robots": []}', ["body", "robots"]),
        (b'{"robots": 1}', ["body", "robots"]),
        (b'{"robots": [{}], "x": 1}', ["body", "x"]),
        (b"[" * 10_000, ["body"]),
        (json.dumps({"robots": [{}] * (MAX_ROBOTS + 1)}).encode(), ["body", "robots"]),
    ],
)
def test_what_is_no_batch_is_422_and_named(app, strict_json, body, where) -> None:
    reply = app.post("/act/batch", content=body)
    assert reply.status_code == 422
    assert strict_json(reply.text)["detail"][0]["loc"] == where


def test_a_batch_may_be_larger_than_one_robots_request_but_not_of_any_size(monitor) -> None:
    app = TestClient(create_app(monitor, max_body=4000))
    asked = {"robots": robots(24)}
    assert len(json.dumps(asked)) > 12_000
    assert app.post("/act/batch", json=asked).status_code == 200
    assert app.post("/act", json=asked).status_code == 413
    assert app.post("/act/batch", content=b" " * 64_001).status_code == 413


def test_a_monitor_that_fails_is_500_and_noted(monitor, monkeypatch) -> None:
    def broken(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Monitor, "decide_batch", broken)
    before = monitor.faults.counts["MemoryError"]
    reply = TestClient(create_app(monitor)).post("/act/batch", json={"robots": robots(2)})
    assert (reply.status_code, reply.json()["detail"][0]["type"]) == (500, "internal")
    assert monitor.faults.counts["MemoryError"] == before + 1


def test_the_schema_tells_what_a_batch_is(app) -> None:
    told = app.get("/openapi.json").json()
    body = told["paths"]["/act/batch"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert body["properties"]["robots"]["items"]["properties"]["observation"]["minItems"] == 60
    replies = told["components"]["schemas"]["BatchReply"]["properties"]["replies"]["items"]["anyOf"]
    assert {one["$ref"].rsplit("/", 1)[1] for one in replies} == {"ActReply", "Refusal"}
