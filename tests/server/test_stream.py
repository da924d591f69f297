"""`WS /act/stream` of a real service: the replies of `POST /act`, in order, behind the same guard."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from evaluation.service import Service
from server import Client
from server.stream import frame

OBSERVATION = [0.25] * 60
KEY = {"x-api-key": "secret"}


@pytest.fixture(scope="module")
def service(tiny_bundle: Path, tmp_path_factory) -> Iterator[Service]:
    """A service with a key, that waits for nobody for long."""
    key = tmp_path_factory.mktemp("key") / "key"
    key.write_text("secret")
    flags = ["--api-key-file", str(key), "--read-seconds", "0.5", "--idle-seconds", "1.5"]
    words = ["-m", "server.serve", str(tiny_bundle), "--port", "0", "--gate", "always", "--max-body", "20000"]
    with Service.run([sys.executable, *words, *flags]) as running:
        yield running


def stream(service: Service, **options: Any) -> ClientConnection:
    url = f"{service.url.replace('http', 'ws')}/act/stream"
    return connect(url, **({"additional_headers": KEY, "ping_interval": None} | options))


def asked(request: int, **more: Any) -> dict[str, Any]:
    return {"observation": OBSERVATION, "hazards": [[0.3, 0.03]], "request": request} | more


def test_frames_are_answered_as_requests_are_in_order(service) -> None:
    body = json.dumps(asked(5)).encode()
    with urlopen(Request(f"{service.url}/act", body, {**KEY, "content-type": "application/json"})) as reply:
        expected = json.load(reply)
    with stream(service) as robot:
        for k in range(8):
            robot.send(json.dumps(asked(k)) if k % 2 else msgpack.packb(asked(k)))
        for k in range(8):
            content = robot.recv(timeout=5.0)
            told = json.loads(content) if k % 2 else msgpack.unpackb(content)
            assert told["request"] == k
            assert set(told) == set(expected)
            for name in set(told) - {"request", "seconds", "memory"}:
                assert told[name] == expected[name], name


def test_a_frame_that_cannot_be_decided_about_is_refused_and_the_next_one_answered(service) -> None:
    bad = ["", "{}", "[1", json.dumps(asked(1, surprise=1)), b"", b"\xc1", msgpack.packb({b"x": 1})]
    bad += [msgpack.packb(asked(1, observation=[float("nan")] * 60)), msgpack.packb({1: 2})]
    with stream(service) as robot:
        for content in bad:
            robot.send(content)
            reply = robot.recv(timeout=5.0)
            told = json.loads(reply) if isinstance(reply, str) else msgpack.unpackb(reply)
            assert told["status"] == 422
            assert told["detail"][0]["loc"][0] == "body"
        robot.send(json.dumps(asked(7)))
        assert json.loads(robot.recv(timeout=5.0))["request"] == 7


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.text(max_size=200) | st.binary(max_size=200))
def test_whatever_is_sent_is_answered(service, content: str | bytes) -> None:
    with stream(service) as robot:
        robot.send(content)
        reply = robot.recv(timeout=5.0)
        told = json.loads(reply) if isinstance(reply, str) else msgpack.unpackb(reply)
        assert told["status"] == 422


@pytest.mark.parametrize(
    ("options", "path", "status"),
    [
        ({"additional_headers": {}}, "", 401),
        ({"additional_headers": {"x-api-key": "wrong"}}, "", 401),
        ({"origin": "http://evil.example"}, "", 403),
        ({}, "/x", 404),
    ],
)
def test_who_may_not_is_refused_before_there_is_a_stream(service, options, path, status) -> None:
    url = f"{service.url.replace('http', 'ws')}/act/stream{path}"
    with pytest.raises(InvalidStatus) as caught:
        connect(url, **({"additional_headers": KEY} | options))
    assert caught.value.response.status_code == status


def test_nothing_is_compressed_and_a_frame_that_is_too_large_ends_the_stream(service) -> None:
    with stream(service) as robot:
        assert not robot.protocol.extensions
        robot.send("x" * 20_001)
        with pytest.raises(ConnectionClosed) as caught:
            robot.recv(timeout=5.0)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1009


def closed_after(robot: ClientConnection) -> float:
    began = time.monotonic()
    with pytest.raises(ConnectionClosed):
        robot.recv(timeout=10.0)
    return time.monotonic() - began


def test_who_is_silent_or_slow_goes_and_who_asks_stays(service) -> None:
    with stream(service) as silent, stream(service) as slow, stream(service) as robot:
        slow.socket.sendall(frame(0x1, json.dumps(asked(1)).encode())[:50])
        # In the middle of a frame half a second is waited; between two, one and a half.
        assert closed_after(slow) < 1.4
        for k in range(8):
            robot.send(json.dumps(asked(k)))
            assert json.loads(robot.recv(timeout=5.0))["request"] == k
            time.sleep(0.15)
        assert closed_after(silent) < 2.0
        robot.send(json.dumps(asked(9)))
        assert json.loads(robot.recv(timeout=5.0))["request"] == 9


def test_frames_far_ahead_of_their_answers_end_the_stream(service) -> None:
    with stream(service) as robot:
        robot.socket.sendall(frame(0x1, json.dumps(asked(1)).encode()) * 200)
        with pytest.raises(ConnectionClosed):
            sum(1 for _ in iter(lambda: robot.recv(timeout=5.0), None))


def test_the_client_over_a_stream_decides_as_over_http(service) -> None:
    url = service.url.replace("http", "ws")
    with (
        Client(service.url, api_key="secret", timeout=5.0) as plain,
        Client(url, api_key="secret", timeout=5.0) as streamed,
    ):
        past: list[np.void | None] = [None, None]
        for hazards in ([[0.3, 0.03]], None, [[0.5, -0.1]], [[0.4, 0.0]] * 100):
            one = plain.decide(OBSERVATION, hazards, past[0])
            two = streamed.decide(OBSERVATION, hazards, past[1])
            assert one.opened_by == two.opened_by == "always"
            assert one.action.tobytes() == two.action.tobytes()
            past = [one.memory, two.memory]
