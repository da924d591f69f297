"""A service in this process and one as users start it."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from decision import MEMORY, Faults
from monitor import Monitor
from pointgoal.lidar import encode
from server.app import create_app
from server.duty import OnDuty
from server.keeper import Keeper, Past
from server.schema import ModelReply


@pytest.fixture(scope="session")
def monitor(tiny_bundle: Path) -> Monitor:
    """A monitor whose filter is always active."""
    return Monitor.load(tiny_bundle, "always")


@pytest.fixture
def app(monitor: Monitor, memory_key: bytes) -> TestClient:
    """The service in this process; what it raises, the test sees."""
    return TestClient(create_app(monitor, memory_key=memory_key))


@pytest.fixture(scope="session")
def memory_key() -> bytes:
    """By which `sealed` seals."""
    return b"k" * 32


@pytest.fixture
def sealed(monitor: Monitor, memory_key: bytes) -> Callable[..., str]:
    """Seals a memory with a plan, and other fields, as a service with `memory_key` does for a robot."""
    keeper, kind = Keeper(memory_key, Faults()), OnDuty.of(monitor).robot

    def seal(plan: list[list[float]], robot: str | None = None, **fields: int) -> str:
        memory = np.zeros(1, MEMORY)
        memory["planned"], memory["left"] = True, len(plan)
        memory["plan"][0, : len(plan)] = np.reshape(plan, (-1, 2))
        for name, value in fields.items():
            memory[name] = value
        return keeper.seal(memory[0], robot, kind, Past(None, None, None))

    return seal


@pytest.fixture
def observation() -> list[float]:
    """An observation [60] of a robot with a hazard in sight."""
    made = np.random.default_rng(5).uniform(0.0, 0.5, 60)
    made[28:44] = encode(np.array([[[1.2, 0.9]]]))[0]
    return [float(value) for value in made]


def no_constant(name: str) -> Any:
    raise AssertionError(f"{name} is no JSON")


@pytest.fixture
def strict_json():
    """Reads JSON that has no NaN and no Infinity."""
    return lambda text: json.loads(text, parse_constant=no_constant)


Behaviour = Callable[[socket.socket, bytes], None]


def http_reply(body: bytes, status: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {status}\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body


@contextmanager
def fake_service(monitor: Monitor, act: Behaviour, model: bytes | None = None) -> Iterator[str]:
    """A server that answers /model rightly and /act as told, each connection in a thread.

    Args:
        monitor: what /model tells.
        act: is given the connection and the request's body.
        model: the answer to /model, if another.
    """
    about = model if model is not None else http_reply(ModelReply.of(monitor).model_dump_json().encode())
    listener = socket.create_server(("127.0.0.1", 0))

    def handle(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            while request := connection.recv(65536):
                if request.startswith(b"GET /model"):
                    connection.sendall(about)
                else:
                    act(connection, request.partition(b"\r\n\r\n")[2])

    def serve() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                threading.Thread(target=handle, args=(connection,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.close()


@pytest.fixture(scope="session")
def fake():
    """`fake_service`."""
    return fake_service


@pytest.fixture(scope="session")
def http():
    """The bytes of an HTTP reply."""
    return http_reply
