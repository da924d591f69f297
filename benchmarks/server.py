"""Latency and throughput of `POST /act` beside a bare FastAPI echo of the same body, in one run.

    python -m benchmarks.server models/NAME

Both run under the same uvicorn settings, each in its own process; rounds alternate between them, so that what
else the machine does hits both. The client is a raw socket: it measures the service, not an HTTP library.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import numpy as np
import tyro
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table

from decision import PLAN_STEPS
from evaluation.service import Service
from models import Bundle
from monitor import GateName
from pointgoal.lidar import encode
from pointgoal.observation import layout
from server.serve import listen


class Echo(BaseModel):
    """The bare endpoint's body and reply."""

    observation: list[float]


@dataclass(frozen=True)
class ServerBenchmark:
    """Measures POST /act against a bare FastAPI echo."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder."""
    gate: GateName = "always"
    """When the filter is active."""
    requests: int = 2000
    """Requests a round and connection."""
    rounds: int = 5
    """Rounds; the median over rounds is printed."""
    connections: int = 4
    """Connections at once for the throughput."""


class Connection:
    """One keep-alive HTTP connection that sends the same request again and again."""

    def __init__(self, url: str, body: bytes) -> None:
        address = urlsplit(url)
        self._socket = socket.create_connection((address.hostname, address.port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        head = f"POST {address.path} HTTP/1.1\r\nhost: {address.netloc}\r\ncontent-type: application/json\r\n"
        self._request = f"{head}content-length: {len(body)}\r\n\r\n".encode() + body

    def exchange(self) -> None:
        """One request and its whole reply; raises RuntimeError if it is not a 200."""
        self._socket.sendall(self._request)
        reply = b""
        while b"\r\n\r\n" not in reply:
            reply += self._receive()
        head, _, body = reply.partition(b"\r\n\r\n")
        if b" 200 " not in head.split(b"\r\n", 1)[0]:
            raise RuntimeError(head.decode())
        length = int(head.lower().split(b"content-length:", 1)[1].split(b"\r\n", 1)[0])
        while len(body) < length:
            body += self._receive()

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


def throughput(url: str, body: bytes, connections: int, requests: int) -> float:
    """Requests a second over several connections at once."""
    opened = [Connection(url, body) for _ in range(connections)]
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


def measure(targets: dict[str, tuple[str, bytes]], config: ServerBenchmark) -> dict[str, dict[str, float]]:
    """Median over rounds of p50 [µs], p99 [µs] and requests a second, for each of name → (url, body)."""
    seen: dict[str, list[tuple[float, float, float]]] = {name: [] for name in targets}
    for _ in range(config.rounds):
        for name, (url, body) in targets.items():
            connection = Connection(url, body)
            connection.times(50)
            p50, p99 = np.percentile(connection.times(config.requests), [50, 99]) * 1e6
            connection.close()
            seen[name].append((p50, p99, throughput(url, body, config.connections, config.requests // 4)))
    names = ("p50_us", "p99_us", "requests_per_second")
    return {
        name: dict(zip(names, np.median(rows, axis=0).tolist(), strict=True)) for name, rows in seen.items()
    }


def run(config: ServerBenchmark) -> dict[str, dict[str, float]]:
    """Starts both services, measures them, stops them."""
    where = layout(Bundle.load(config.bundle).manifest.level)
    seen = np.random.default_rng(0).uniform(0.0, 0.6, where.size)
    if "hazards_lidar" in where:
        seen[where.slice("hazards_lidar")] = encode(np.array([[[1.5, 1.2]]]))[0]
    observation = seen.tolist()
    plain = json.dumps({"observation": observation}).encode()
    given: dict[str, Any] = {
        "observation": observation,
        "hazards": [[1.0 + 0.2 * k, 0.3 * k] for k in range(8)],
    }
    plan = [[0.05, 0.5]] * PLAN_STEPS
    driving = given | {"request": 1, "memory": {"side": 5, "guided": 0, "open": 0, "plan": plan}}
    with ExitStack() as stack:
        service = stack.enter_context(Service.start(config.bundle, config.gate))
        echo = stack.enter_context(Service.run([sys.executable, "-m", "benchmarks.server", "--echo"]))
        return measure(
            {
                "bare FastAPI echo": (f"{echo.url}/echo", plain),
                "POST /act, lidar": (f"{service.url}/act", plain),
                "POST /act, 8 hazards": (f"{service.url}/act", json.dumps(given).encode()),
                "POST /act, 8 hazards, a full memory": (f"{service.url}/act", json.dumps(driving).encode()),
            },
            config,
        )


def serve_echo() -> None:
    """The bare service: FastAPI as its tutorial has it, under the settings of `lagnet-serve`."""
    app = FastAPI()

    @app.post("/echo")
    async def echo(body: Echo) -> Echo:
        return body

    listener = listen("127.0.0.1", 0, None)
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
    table = Table("", "p50 [µs]", "p99 [µs]", f"requests/s ({config.connections} connections)")
    for name, row in run(config).items():
        table.add_row(name, *(f"{value:,.0f}" for value in row.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
