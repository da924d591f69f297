"""A policy that takes long holds up nobody who asks whether the service is alive."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
from fastapi.testclient import TestClient
from onnx import helper, numpy_helper

from evaluation.service import Service
from models import Bundle, write_bundle
from monitor import Monitor
from server.app import create_app

SIDE = 2800
"""Side of the square matrices that the slow policy multiplies."""


@pytest.fixture(scope="module")
def slow_bundle(tmp_path_factory, tiny_bundle: Path) -> Path:
    """The tiny bundle, whose policy also multiplies two large matrices."""
    bundle = Bundle.load(tiny_bundle)
    policy = onnx.load_from_string(bundle.policy)
    graph = policy.graph
    last = graph.node[-1].output[0]
    graph.node[-1].output[0] = "quick"
    graph.initializer.extend(
        [
            numpy_helper.from_array(np.array([SIDE, SIDE], np.int64), "square"),
            numpy_helper.from_array(np.array(0.0, np.float32), "nothing"),
        ]
    )
    graph.node.extend(
        [
            # From the observation, so that it cannot be computed once and for all.
            helper.make_node("ReduceMean", ["observation"], ["mean"], keepdims=1),
            helper.make_node("Expand", ["mean", "square"], ["large"]),
            helper.make_node("MatMul", ["large", "large"], ["product"]),
            helper.make_node("ReduceMean", ["product"], ["one"], keepdims=1),
            helper.make_node("Mul", ["one", "nothing"], ["zero"]),
            helper.make_node("Add", ["quick", "zero"], [last]),
        ]
    )
    path = tmp_path_factory.mktemp("bundles") / "slow"
    made: Bundle = write_bundle(path, policy.SerializeToString(), bundle.multiplier, bundle.manifest)
    return made.path


def ask(link: http.client.HTTPConnection, method: str, path: str, body: bytes | None = None) -> bytes:
    link.request(method, path, body)
    reply = link.getresponse()
    assert reply.status == 200
    return reply.read()


@pytest.fixture(scope="module")
def port(slow_bundle: Path) -> Iterator[int]:
    """The port of a service whose policy takes some 200 ms."""
    with Service.start(slow_bundle, "risk") as service:
        yield int(service.url.rsplit(":", 1)[1])


@pytest.mark.parametrize("path", ["/act", "/act/batch"])
def test_health_checks_are_answered_while_a_decision_is_made(port: int, observation, path: str) -> None:
    asked = {"observation": observation}
    body = json.dumps(asked if path == "/act" else {"robots": [asked]}).encode()
    took: list[float] = []

    def drive() -> None:
        robot = http.client.HTTPConnection("127.0.0.1", port)
        for _ in range(5):
            started = time.monotonic()
            ask(robot, "POST", path, body)
            took.append(time.monotonic() - started)

    driving = threading.Thread(target=drive)
    driving.start()
    checks = http.client.HTTPConnection("127.0.0.1", port)
    waited = []
    while driving.is_alive():
        for check in ("/healthz", "/readyz"):
            started = time.monotonic()
            ask(checks, "GET", check)
            waited.append(time.monotonic() - started)
        time.sleep(0.005)
    driving.join()
    assert len(took) == 5
    assert min(took) > 0.06, "the policy is not slow"
    assert len(waited) > 20
    # Not the longest: the machine may have been busy elsewhere. If they waited, each would for a decision.
    assert np.median(waited) < 0.05


def test_only_slow_decisions_are_made_in_a_thread(monitor, observation, monkeypatch) -> None:
    threads: list[str] = []
    seconds = [0.0]
    decide = Monitor.decide

    def watched(self, *arguments):
        threads.append(threading.current_thread().name)
        time.sleep(seconds[0])
        return decide(self, *arguments)

    monkeypatch.setattr(Monitor, "decide", watched)
    app = TestClient(create_app(monitor))

    def asks(times: int) -> list[bool]:
        """Of each decision whether it was made in the thread for slow ones."""
        threads.clear()
        for _ in range(times):
            assert app.post("/act", json={"observation": observation}).status_code == 200
        return [name.startswith("decisions") for name in threads]

    # Until they are known to be quick, they may not be.
    assert asks(10) == [True] * 10
    for _ in range(40):
        asks(1)
    assert asks(5) == [False] * 5
    seconds[0] = 0.02
    assert asks(5) == [False, True, True, True, True]
