"""The client always has an action, in time, whatever the other side does."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from evaluation.service import Service
from pointgoal.observation import layout
from server import Client, ClientError, ModelReply

Behaviour = Callable[[socket.socket], None]


def http(body: bytes, status: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {status}\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body


@contextmanager
def fake_service(monitor, act: Behaviour, model: bytes | None = None) -> Iterator[str]:
    """A server that answers /model rightly and /act as told, one connection after the other."""
    about = model if model is not None else http(ModelReply.of(monitor).model_dump_json().encode())
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                with connection, suppress(OSError):
                    while request := connection.recv(65536):
                        if request.startswith(b"GET /model"):
                            connection.sendall(about)
                        else:
                            act(connection)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    listener.close()


def silence(connection: socket.socket) -> None:
    time.sleep(0.6)


def trickle(connection: socket.socket) -> None:
    for byte in http(b"{" + b" " * 100):
        connection.sendall(bytes([byte]))
        time.sleep(0.05)


def trickling_headers(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\n")
    for k in range(60):
        connection.sendall(f"x-{k}: 1\r\n".encode())
        time.sleep(0.05)


def hang_up(connection: socket.socket) -> None:
    connection.shutdown(socket.SHUT_RDWR)


def cut_short(connection: socket.socket) -> None:
    connection.sendall(b'HTTP/1.1 200 OK\r\ncontent-length: 500\r\n\r\n{"action": [1')
    connection.shutdown(socket.SHUT_RDWR)


def says(reply: bytes) -> Behaviour:
    return lambda connection: connection.sendall(reply)


GOOD = {
    "action": [0.5, 0.5],
    "nominal_action": [0.5, 0.5],
    "risk": 0.1,
    "threshold": 0.5,
    "mode": "nominal",
    "barrier": 1.0,
    "hazard": None,
    "row": None,
    "reason": None,
    "gate_open": False,
    "model": "x",
    "seconds": 0.001,
    "memory": None,
}


def replies(**changes: object) -> Behaviour:
    return says(http(json.dumps(GOOD | changes).encode()))


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        (silence, "no reply within 0.3 s"),
        (trickle, "no reply within 0.3 s"),
        (trickling_headers, "no reply within 0.3 s"),
        (hang_up, "connection"),
        (cut_short, "connection"),
        (says(b"SSH-2.0-OpenSSH_9.2\r\n"), "connection"),
        (says(http(b"", "503 Service Unavailable")), "answered 503"),
        (says(http(b'{"detail": "x"}', "422 Unprocessable")), "answered 422"),
        (says(http(b"", "302 Found")), "answered 302"),
        (says(http(b"not json")), "the reply is not one"),
        (says(http(b"{}")), "the reply is not one"),
        (replies(action=[float("nan"), 0.0]), "the reply is not one"),
        (replies(action=["1", "2"]), "the reply is not one"),
        (replies(action=[1.0]), "the reply is not one"),
        (replies(mode="reckless"), "the reply is not one"),
    ],
)
def test_a_service_that_misbehaves_gets_zero_thrust_in_time(monitor, observation, behaviour, reason) -> None:
    with fake_service(monitor, behaviour) as url, Client(url, timeout=0.3) as client:
        started = time.monotonic()
        reply = client.act(observation)
        assert time.monotonic() - started < 2.0
        assert (reply.mode, reply.action) == ("fallback", [0.0, 0.0])
        assert reason in str(reply.reason)
        assert reply.model is None


def test_a_fault_forgets_the_filters_memory(monitor, observation) -> None:
    seen: list[bool] = []
    answers = iter([replies(memory={"side": [1]}), replies(action=["1", "2"]), replies()])

    def in_turn(connection: socket.socket) -> None:
        next(answers)(connection)

    with fake_service(monitor, in_turn) as url, Client(url) as client:
        exchange = client._link.exchange

        def watched(method: str, path: str, body: bytes, timeout: float) -> tuple[int, bytes]:
            seen.append(b"memory" in body)
            return exchange(method, path, body, timeout)

        client._link.exchange = watched
        modes = [client.act(observation).mode for _ in range(3)]
    assert modes == ["nominal", "fallback", "nominal"]
    assert seen == [False, True, False]


def test_it_goes_on_after_a_fault(monitor, observation) -> None:
    answers = iter([silence, replies(), hang_up, replies(action=[0.25, 0.0])])

    def in_turn(connection: socket.socket) -> None:
        next(answers)(connection)

    with (
        fake_service(monitor, in_turn) as url,
        Client(url, timeout=0.3) as client,
    ):
        assert client.act(observation).mode == "fallback"
        time.sleep(0.5)
        assert client.act(observation).action == [0.5, 0.5]
        # The third answer hangs up on a kept connection: asked once more on a fresh one.
        assert client.act(observation).action == [0.25, 0.0]


@pytest.mark.parametrize("bad", [[float("nan")] * 60, [float("inf")] * 60, ["x"] * 60, [10**400], None])
def test_what_cannot_be_sent_gets_zero_thrust(monitor, bad) -> None:
    with fake_service(monitor, replies()) as url, Client(url) as client:
        reply = client.act(bad)
        assert reply.mode == "fallback"
        assert "cannot be sent" in str(reply.reason)


def test_the_real_service_and_after_its_end(tiny_bundle: Path, monitor, observation) -> None:
    with Service.start(tiny_bundle, "always") as service:
        client = Client(service.url, layout(1).to_json(), timeout=5.0)
        reply = client.act(observation, [[0.45, 0.0]])
        assert reply.action == monitor.decide(observation, [[0.45, 0.0]]).action.tolist()
        assert client.model().model == monitor.bundle.id
        # A wrong length is the service's 422, and the robot's zero thrust.
        assert "must have 60 numbers" in str(client.act(observation[:-1]).reason)
    reply = client.act(observation)
    assert (reply.mode, reply.action) == ("fallback", [0.0, 0.0])
    assert "connection" in str(reply.reason)
    client.close()


def test_another_observation_layout_is_refused_before_the_robot_moves(monitor) -> None:
    with fake_service(monitor, replies()) as url:
        Client(url, layout(1).to_json()).close()
        with pytest.raises(ClientError, match="another observation layout"):
            Client(url, layout(0).to_json())


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1:1",
        "127.0.0.1:8000",
        "ftp://x",
        "http://",
        "http://x:y",
        "http://h/p",
        f"http://{'a' * 70}",
    ],
)
def test_a_service_that_is_not_there_is_an_error_at_connect(url: str) -> None:
    with pytest.raises(ClientError):
        Client(url)


@pytest.mark.parametrize(
    "model", [http(b"{}"), http(b"hello"), http(b"", "404 Not Found"), b"nonsense\r\n\r\n"]
)
def test_what_is_no_lagnet_service_is_an_error_at_connect(monitor, model: bytes) -> None:
    with fake_service(monitor, replies(), model) as url, pytest.raises(ClientError):
        Client(url)


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(timeout: float) -> None:
    with pytest.raises(ValueError, match="timeout"):
        Client("http://127.0.0.1:1", timeout=timeout)


@pytest.mark.parametrize("key", ["two\r\nx-other: header", "schl\u00fcssel"])
def test_a_key_that_no_header_can_carry_is_refused(key: str) -> None:
    with pytest.raises(ValueError, match="API key"):
        Client("http://127.0.0.1:1", api_key=key)
