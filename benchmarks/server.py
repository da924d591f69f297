"""Latency of `POST /act` and `WS /act/stream` beside a bare FastAPI echo of the same body, and in process.

    python -m benchmarks.server models/NAME

Both run under the same uvicorn settings, each in its own process; rounds alternate between them, so that what
else the machine does hits both. The client is a raw socket: it measures the service, not an HTTP library.
"""

from __future__ import annotations

import json
import math
import secrets
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Annotated, Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
import tyro
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table

from decision import MEMORY, PLAN_STEPS, Faults, Mode, unpack
from evaluation.service import Service
from monitor import GateName, Monitor
from pointgoal.lidar import encode
from pointgoal.observation import layout
from server.duty import OnDuty
from server.keeper import KEY_BYTES, Keeper, Past
from server.keys import Keys
from server.serve import listen
from server.stream import BINARY, TEXT, frame


class Echo(BaseModel):
    """The bare endpoint's body and reply."""

    request: int
    observation: list[float]
    hazards: list[list[float]] | None = None
    memory: str | None = None


@dataclass(frozen=True)
class ServerBenchmark:
    """Measures POST /act against a bare FastAPI echo."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder."""
    gate: GateName = "risk"
    """When the filter is active."""
    requests: int = 2000
    """Requests a round."""
    rounds: int = 5
    """Rounds; the median over rounds is printed."""
    clients: tuple[int, ...] = (1, 8, 64)
    """Connections at once for the throughput."""


class Connection:
    """One keep-alive HTTP connection that sends the same requests again and again, in turn."""

    def __init__(self, url: str, *bodies: bytes) -> None:
        address = urlsplit(url)
        self._socket = socket.create_connection((address.hostname, address.port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        head = f"POST {address.path} HTTP/1.1\r\nhost: {address.netloc}\r\ncontent-type: application/json\r\n"
        self._requests = cycle([f"{head}content-length: {len(b)}\r\n\r\n".encode() + b for b in bodies])

    def exchange(self) -> bytes:
        """One request; its reply's body. Raises RuntimeError if it is not a 200."""
        self._socket.sendall(next(self._requests))
        reply = b""
        while b"\r\n\r\n" not in reply:
            reply += self._receive()
        head, _, body = reply.partition(b"\r\n\r\n")
        if b" 200 " not in head.split(b"\r\n", 1)[0]:
            raise RuntimeError(head.decode())
        length = int(head.lower().split(b"content-length:", 1)[1].split(b"\r\n", 1)[0])
        while len(body) < length:
            body += self._receive()
        return body

    def times(self, requests: int) -> list[float]:
        """Seconds of each of some requests."""
        result = []
        for _ in range(requests):
            started = time.perf_counter()
            self.exchange()
            result.append(time.perf_counter() - started)
        return result

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()

    def _receive(self) -> bytes:
        part = self._socket.recv(65536)
        if not part:
            raise RuntimeError("the service closed the connection")
        return part


class Stream(Connection):
    """One `WS /act/stream` that sends the same frames again and again, in turn."""

    def __init__(self, url: str, *bodies: bytes) -> None:
        address = urlsplit(url)
        self._socket = socket.create_connection((address.hostname, address.port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(
            f"GET {address.path} HTTP/1.1\r\nhost: {address.netloc}\r\nconnection: upgrade\r\n"
            "upgrade: websocket\r\nsec-websocket-version: 13\r\n"
            "sec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        if b" 101 " not in self._receive():
            raise RuntimeError("the service opens no stream")
        packed = address.fragment == "msgpack"
        self._requests = cycle(
            [frame(BINARY, msgpack.packb(json.loads(b))) if packed else frame(TEXT, b) for b in bodies]
        )

    def exchange(self) -> bytes:
        """One frame each way: what the reply holds."""
        self._socket.sendall(next(self._requests))
        reply = self._receive()
        # 126 says that two bytes of length follow: no reply is shorter, and none longer than they can say.
        if reply[1] != 126:
            raise RuntimeError("no reply has this length")
        length = 4 + int.from_bytes(reply[2:4])
        while len(reply) < length:
            reply += self._receive()
        return reply[4:]


def connect(url: str, *bodies: bytes) -> Connection:
    """A connection that sends some bodies: a stream for "ws://", of msgpack with "#msgpack" behind it."""
    return (Stream if url.startswith("ws") else Connection)(url, *bodies)


def throughput(url: str, body: bytes, connections: int, requests: int) -> float:
    """Requests a second over several connections at once."""
    opened = [connect(url, body) for _ in range(connections)]
    threads = [threading.Thread(target=connection.times, args=(requests,)) for connection in opened]
    started = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    elapsed = time.perf_counter() - started
    for connection in opened:
        connection.close()
    return connections * requests / elapsed


@dataclass(frozen=True)
class Case:
    """What is measured.

    Attributes:
        asked: the request's body.
        mode: what the decision must be, or None for the echo: nobody wants to know how fast it falls back.
    """

    asked: dict[str, Any]
    mode: Mode | None = None

    @property
    def body(self) -> bytes:
        """As it goes over the wire."""
        return json.dumps(self.asked).encode()


def cases(level: int, memory: str) -> dict[str, Case]:
    """A robot at rest with a hazard in sight, and one that would drive into it."""
    blocks = layout(level)
    at_rest = np.zeros(blocks.size)
    at_rest[blocks.slice("accelerometer")] = (0.0, 0.0, 9.81)
    at_rest[blocks.slice("magnetometer")] = (0.0, -0.5, 0.0)
    driving = at_rest.copy()
    driving[blocks.slice("velocimeter")] = (0.8, 0.0, 0.0)
    ahead = blocks.slice("goal_lidar").start
    driving[[ahead, ahead + 1, ahead + 15]] = (0.5, 0.25, 0.25)
    far, near = np.array([[[1.5, 1.2]]]), np.array([[[0.3, 0.03]]])
    if "hazards_lidar" in blocks:
        at_rest[blocks.slice("hazards_lidar")] = encode(far)[0]
        driving[blocks.slice("hazards_lidar")] = encode(near)[0]
    plain = {"request": 1, "observation": at_rest.tolist()}
    stop = {"request": 1, "observation": driving.tolist(), "hazards": near[0].tolist(), "memory": memory}
    return {
        "nominal": Case(plain, Mode.NOMINAL),
        "nominal, a full memory": Case(plain | {"memory": memory}, Mode.NOMINAL),
        "the filter acts": Case(stop, Mode.FILTERED),
    }


def full_memory(monitor: Monitor, key: bytes) -> str:
    """A memory with a whole plan, as the service of a key sends it."""
    memory = np.zeros(1, MEMORY)
    memory["side"], memory["planned"], memory["left"] = 5, True, PLAN_STEPS
    memory["plan"] = (0.05, 0.5)
    return Keeper(key, Faults()).seal(memory[0], None, OnDuty.of(monitor).robot, Past(None, None, None))


def in_process(monitor: Monitor, asked: dict[str, Any], calls: int) -> tuple[float, float]:
    """Median and 99th percentile of a decision in this process [µs]."""
    memory = unpack(asked["memory"]) if "memory" in asked else None
    times = []
    for _ in range(calls + 50):
        started = time.perf_counter()
        monitor.decide(asked["observation"], asked.get("hazards"), memory)
        times.append(time.perf_counter() - started)
    p50, p99 = np.percentile(times[50:], [50, 99]) * 1e6
    return float(p50), float(p99)


def over_http(url: str, case: Case, config: ServerBenchmark) -> list[float]:
    """Median and 99th percentile [µs], and requests a second at each number of clients."""
    connection = connect(url, case.body)
    if case.mode is not None:
        read = msgpack.unpackb if url.endswith("#msgpack") else json.loads
        if (mode := read(connection.exchange())["mode"]) != case.mode:
            raise RuntimeError(f"{url}: the decision is {mode}, expected {case.mode}")
    connection.times(50)
    p50, p99 = np.percentile(connection.times(config.requests), [50, 99]) * 1e6
    connection.close()
    rates = [throughput(url, case.body, n, max(1, config.requests // n)) for n in config.clients]
    return [float(p50), float(p99), *rates]


@contextmanager
def with_key(bundle: Path, gate: GateName, key: bytes) -> Iterator[Service]:
    """A service that seals memories with a key, so that others can make them, see `full_memory`."""
    with NamedTemporaryFile() as file:
        file.write(key)
        file.flush()
        with Service.start(bundle, gate, None, "--memory-key-file", file.name) as service:
            yield service


def run(config: ServerBenchmark) -> dict[str, list[float]]:
    """Starts both services, measures them in turn, stops them; the medians over rounds."""
    monitor = Monitor.load(config.bundle, config.gate)
    key = secrets.token_bytes(KEY_BYTES)
    measured = cases(monitor.bundle.manifest.level, full_memory(monitor, key))
    seen: dict[str, list[list[float]]] = {}
    with ExitStack() as stack:
        service = stack.enter_context(with_key(config.bundle, config.gate, key))
        echo = stack.enter_context(Service.run([sys.executable, "-m", "benchmarks.server", "--echo"]))
        for _ in range(config.rounds):
            for name, case in measured.items():
                plain = Case(case.asked)
                seen.setdefault(f"echo: {name}", []).append(over_http(f"{echo.url}/echo", plain, config))
                seen.setdefault(f"in process: {name}", []).append(
                    [*in_process(monitor, case.asked, config.requests), *[math.nan] * len(config.clients)]
                )
                stream = f"{service.url.replace('http', 'ws')}/act/stream"
                for kind, url in (
                    ("POST /act", f"{service.url}/act"),
                    ("stream, JSON", stream),
                    ("stream, msgpack", f"{stream}#msgpack"),
                ):
                    seen.setdefault(f"{kind}: {name}", []).append(over_http(url, case, config))
    return {name: np.median(rows, axis=0).tolist() for name, rows in seen.items()}


def serve_echo() -> None:
    """The bare service: FastAPI as its tutorial has it, under the settings of `lagnet-serve`."""
    app = FastAPI()

    @app.post("/echo")
    async def echo(body: Echo) -> Echo:
        return body

    listener = listen("127.0.0.1", 0, Keys())
    print(json.dumps({"url": f"http://127.0.0.1:{listener.getsockname()[1]}"}), flush=True)
    uvicorn.Server(uvicorn.Config(app, access_log=False, log_level="warning", ws="none")).run(
        sockets=[listener]
    )


def main() -> None:
    """Entry point of `python -m benchmarks.server`."""
    if sys.argv[1:] == ["--echo"]:
        serve_echo()
        return
    config = tyro.cli(ServerBenchmark, prog="python -m benchmarks.server")
    rows = run(config)
    table = Table("", "p50 [µs]", "p99 [µs]", "p50 / echo", "p99 / echo")
    for clients in config.clients:
        table.add_column(f"requests/s, {clients} at once")
    for name, (p50, p99, *rates) in rows.items():
        echo50, echo99 = rows[f"echo: {name.partition(': ')[2]}"][:2]
        told = (f"{rate:,.0f}" if math.isfinite(rate) else "" for rate in rates)
        table.add_row(name, f"{p50:,.0f}", f"{p99:,.0f}", f"{p50 / echo50:.2f}", f"{p99 / echo99:.2f}", *told)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
