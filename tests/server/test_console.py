"""What an operator asks and says: metrics that agree with what was answered, alarms, the hold."""

from __future__ import annotations

import math
from collections import Counter
from typing import ClassVar

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from decision import Faults, Mode
from monitor import Monitor
from server.alarms import RULES
from server.app import create_app
from server.duty import UNDECIDED
from server.keys import Keys
from server.metrics import MOST_KINDS
from server.operation import Operation
from server.tally import OTHER, REASONS, Histogram, kind_of

KEYS = Keys(act="key", admin="master")
ROBOT, ADMIN = {"x-api-key": "key"}, {"x-api-key": "master"}
INSIDE = [[0.05, 0.0]]
"""A hazard in which the robot stands."""


@pytest.fixture
def operation(monitor: Monitor) -> Operation:
    mine = Monitor.__new__(Monitor)
    mine.__dict__ |= monitor.__dict__ | {"faults": Faults("lagnet.test")}
    mine.stopwatch.laps.clear()
    return Operation(mine)


@pytest.fixture
def service(operation: Operation, memory_key: bytes) -> TestClient:
    monitor = operation.duty.now.monitor
    app = create_app(monitor, operation=operation, keys=KEYS, max_body=20_000, memory_key=memory_key)
    return TestClient(app, headers=ROBOT)


def scrape(service: TestClient) -> dict[tuple[str, ...], float]:
    """Name and values of the labels → value."""
    reply = service.get("/metrics")
    assert reply.status_code == 200
    assert reply.headers["content-type"].startswith("text/plain; version=0.0.4")
    found = {}
    for family in text_string_to_metric_families(reply.text):
        assert family.documentation
        assert family.name.startswith("lagnet_")
        for sample in family.samples:
            key = (
                sample.name.removeprefix("lagnet_"),
                *(sample.labels[name] for name in sorted(sample.labels)),
            )
            assert key not in found
            found[key] = sample.value
    return found


def test_the_metrics_agree_with_the_answers(service, operation, observation) -> None:
    replies = []
    for hazards in (None, [[0.45, 0.0]], INSIDE):
        replies.append(service.post("/act", json={"observation": observation, "hazards": hazards}).json())
    asked = {"robots": [{"observation": observation}, {"observation": [1e300] * 60}, {"observation": [1.0]}]}
    replies += service.post("/act/batch", json=asked).json()["replies"][:2]
    assert service.post("/act", json={}).status_code == 422
    assert service.post("/act", content=b"x" * 20_001).status_code == 413
    assert service.post("/hold").status_code == 403
    seen = scrape(service)
    modes = Counter(reply["mode"] for reply in replies)
    opened = Counter(reply["opened_by"] or "closed" for reply in replies)
    origins = Counter(reply["origin"] for reply in replies if reply["origin"])
    assert modes["fallback"] >= 2
    for name, counted in (("decisions", modes), ("gate", opened), ("interventions", origins)):
        told = {key[1]: value for key, value in seen.items() if key[0] == f"{name}_total"}
        assert Counter({label: int(value) for label, value in told.items() if value}) == counted, name
    assert seen["requests_total", "/act", "200"] == 3
    assert seen["requests_total", "/act/batch", "200"] == 1
    assert {key[1]: value for key, value in seen.items() if key[0] == "refusals_total"} == {
        "422": 1,
        "413": 1,
        "403": 1,
    }
    assert seen["fallbacks_total", "bad input"] == 1
    assert seen["fallbacks_total", "inside a hazard"] == 1
    assert seen["faults_total", "bad input"] == 1
    for name in ("risk", "barrier_metres", "novelty"):
        field = name.removesuffix("_metres")
        known = [reply[field] for reply in replies if reply[field] is not None]
        assert seen[f"{name}_bucket", "+Inf"] == len(known)
        assert seen[f"{name}_bucket", "1.0"] == sum(number <= 1.0 for number in known)
    assert seen["request_seconds_count",] == seen["queue_seconds_count",] + 1  # the refused one
    # A batch with a robot that spoils it is decided robot by robot.
    assert seen["inference_seconds_count",] == seen["filter_seconds_count",] == 4
    assert seen["bundle_info", "random", "always", "ahead", operation.duty.now.model.model, "PointGoal1-v0"]
    assert seen["gate_open_ratio",] == pytest.approx(1 - opened["closed"] / len(replies))
    assert seen["process_resident_memory_bytes",] > 1e6


@given(st.lists(st.floats(), max_size=50), st.lists(st.floats(-10, 10), min_size=1, max_size=8, unique=True))
def test_a_histogram_counts_what_is_finite(numbers: list[float], bounds: list[float]) -> None:
    histogram = Histogram(sorted(bounds))
    for number in numbers:
        histogram.add(number)
    finite = [number for number in numbers if math.isfinite(number)]
    for name, count in histogram.cumulated():
        assert count == sum(number <= float(name) for number in finite)
    assert histogram.sum == pytest.approx(sum(finite)) or not math.isfinite(sum(finite))


@given(st.lists(st.floats(0, 12), min_size=1), st.floats(0.01, 1.0), st.lists(st.floats(0, 12)))
def test_a_quantile_is_the_bound_above_the_number(numbers, share, before) -> None:
    histogram = Histogram([float(k) for k in range(11)])
    for number in before:
        histogram.add(number)
    counts = list(histogram.counts)
    assert histogram.quantile(share, counts) is None
    for number in numbers:
        histogram.add(number)
    least = sorted(numbers)[max(0, math.ceil(round(share * len(numbers), 9)) - 1)]
    found = histogram.quantile(share, counts)
    assert found is not None
    assert found >= least
    assert found == math.inf or found - 1.0 < least or found == 0.0


@given(st.text(max_size=30) | st.none())
def test_whatever_the_reason_its_kind_is_one_of_few(reason: str | None) -> None:
    assert kind_of(reason) in REASONS


def test_kinds_of_faults_are_bounded(service, operation) -> None:
    for k in range(3 * MOST_KINDS):
        operation.duty.now.monitor.faults.note(f"kind {k}", "a test")
    kinds = {key[1]: value for key, value in scrape(service).items() if key[0] == "faults_total"}
    assert len(kinds) == MOST_KINDS + 1
    assert sum(kinds.values()) == 3 * MOST_KINDS
    assert kind_of("some error") == OTHER == "fault"


def test_a_hold_plays_the_plan_then_coasts_until_it_is_lifted(service, observation, sealed) -> None:
    plan = [[0.5, 0.25], [-0.5, 0.0]]
    memory = sealed(plan)
    body = {"observation": observation, "memory": memory}
    mode = service.post("/act", json=body).json()["mode"]
    assert mode != "fallback"
    reply = service.post("/hold", json={"why": "a child is on the floor"}, headers=ADMIN)
    assert reply.json() == {"state": "hold", "why": "a child is on the floor"}
    assert service.post("/hold", headers=ADMIN).json() == reply.json()
    assert (service.get("/readyz").status_code, service.get("/readyz").json()["status"]) == (200, "hold")
    assert service.get("/healthz").json()["state"] == "hold"
    body["memory"] = sealed(plan)
    batch = service.post("/act/batch", json={"robots": [body, {"observation": observation}]}).json()
    assert [one["action"] for one in batch["replies"]] == [plan[0], [0.0, 0.0]]
    body["memory"] = sealed(plan)
    for expected in (*plan, [0.0, 0.0], [0.0, 0.0]):
        told = service.post("/act", json=body).json()
        assert (told["action"], told["mode"]) == (expected, Mode.FALLBACK)
        assert told["reason"] == UNDECIDED + "hold: a child is on the floor"
        body["memory"] = told["memory"]
    seen = scrape(service)
    assert (seen["state", "hold"], seen["state", "ready"], seen["held",]) == (1.0, 0.0, 1.0)
    assert seen["fallbacks_total", "hold"] == 6
    # A hold's fallbacks are no alarm.
    assert seen["alarm", "fallbacks", "clear"] == 1.0
    assert service.post("/resume").status_code == 403
    assert service.post("/resume", headers=ADMIN).json()["state"] == "ready"
    assert (
        service.post("/act", json={"observation": observation, "memory": sealed(plan)}).json()["mode"] == mode
    )
    assert service.post("/resume", headers=ADMIN).status_code == 409


def test_nobody_resumes_while_an_alarm_holds(monitor, observation) -> None:
    rules = RULES | {"staleness": RULES["staleness"].model_copy(update={"effect": "hold"})}
    operation = Operation(monitor, rules=rules)
    service = TestClient(create_app(monitor, operation=operation, keys=KEYS), headers=ROBOT)
    operation.alarms.raise_("staleness", "robot 7")
    assert service.get("/alarms").status_code == 200
    assert (
        service.post("/act", json={"observation": observation}).json()["reason"]
        == UNDECIDED + "hold: alarm staleness"
    )
    reply = service.post("/resume", headers=ADMIN)
    assert reply.status_code == 409
    assert "staleness" in reply.json()["detail"]


def test_an_alarm_is_told_acknowledged_and_has_an_incident_written(monitor, observation) -> None:
    class Heard:
        alarm = None
        incidents: ClassVar[list[str]] = []

        def incident(self, why: str) -> None:
            self.incidents.append(why)

        def status(self) -> dict[str, object]:
            return {"alarm": self.alarm, "dropped": 0}

        def record(self, *_: object) -> None:
            pass

    operation = Operation(monitor, recorder=Heard())
    service = TestClient(create_app(monitor, operation=operation))
    service.post("/act", json={"observation": observation, "hazards": INSIDE})
    told = {alarm["name"]: alarm for alarm in service.get("/alarms").json()}
    assert set(told) == set(RULES)
    assert (told["fallbacks"]["state"], told["fallbacks"]["acknowledged"]) == ("active", False)
    assert told["fallbacks"]["cause"] == "1 of 1 decisions were fallbacks"
    assert [why.partition(":")[0] for why in Heard.incidents] == ["alarm fallbacks"]
    Heard.alarm = "recording stopped: No space left on device"
    assert scrape(service)["recorder_stopped",] == 1.0
    assert operation.alarms.alarms["recorder"].cause == Heard.alarm
    # One that has stopped is not asked to write.
    assert len(Heard.incidents) == 1
    after = service.post("/alarms/fallbacks/acknowledge").json()
    assert {alarm["name"]: alarm["acknowledged"] for alarm in after}["fallbacks"]
    assert service.post("/alarms/nothing/acknowledge").status_code == 404
    assert service.get("/readyz").status_code == 200


def test_a_window_forgets(monitor, observation) -> None:
    operation = Operation(monitor)
    service = TestClient(create_app(monitor, operation=operation))
    now = operation._marks[-1].at
    service.post("/act", json={"observation": observation, "hazards": INSIDE})
    operation.tick(now + 1.0)
    assert operation.alarms.alarms["fallbacks"].value == 1.0
    for _ in range(120):
        service.post("/act", json={"observation": observation})
    operation.tick(now + 2.0)
    assert operation.alarms.alarms["fallbacks"].value == pytest.approx(1 / 121)
    for k in range(3, 14):
        operation.tick(now + k)
    # Nobody asked for 10 s: nothing is known, and nothing is taken back.
    assert operation.alarms.alarms["fallbacks"].value is None
    assert operation.alarms.alarms["fallbacks"].standing == "active"


@pytest.mark.parametrize("path", ["/hold", "/resume", "/model"])
def test_commands_take_the_admin_key(monitor, path: str) -> None:
    service = TestClient(create_app(monitor, keys=KEYS))
    assert service.post(path, json={}).status_code == 401
    assert service.post(path, json={}, headers={"x-api-key": "key"}).status_code == 403
    assert service.post(path, json={"bundle": "x"}, headers=ADMIN).status_code not in (401, 403, 500)
    assert service.get("/model", headers={"x-api-key": "key"}).status_code == 200
    assert service.get("/model", headers=ADMIN).status_code == 200


@pytest.mark.parametrize(
    "body", [b"{", b'{"why": NaN}', b'{"why": ""}', b'{"x": 1}', b"[]", b"\xff", b'{"why":1}']
)
def test_bodies_that_are_none_are_refused_in_strict_json(service, strict_json, body: bytes) -> None:
    for path in ("/hold", "/model"):
        reply = service.post(path, content=body, headers=ADMIN | {"content-type": "application/json"})
        assert reply.status_code in (400, 404, 422), (path, body)
        strict_json(reply.text)
    assert service.get("/readyz").json() == {"status": "ready"}


def test_a_held_robot_is_never_sent_the_policys_action(operation, observation) -> None:
    """Whatever memory it brings, and whatever it sees."""
    operation.hold("a test")
    decider = operation.duty.now.decider
    rng = np.random.default_rng(0)
    memory = None
    for _ in range(5):
        decision = decider.decide(rng.normal(size=60), rng.normal(size=(3, 2)), memory)
        assert decision.action.tolist() == [0.0, 0.0]
        assert decision.mode is Mode.FALLBACK
        memory = decision.memory
