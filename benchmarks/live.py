"""What the live page costs `POST /act`: one service, asked in turn with and without somebody who watches.

    python -m benchmarks.live models/NAME

Each round with a watcher is measured against the round beside it, so that what else the machine does hits
both. The watcher looks at the robot that asks, and reads after the round: what a browser computes is not the
service's. What is told last is what the hub adds to a decision while nobody watches.
"""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.recording import RecordingBenchmark, bodies, slower, times
from benchmarks.server import Connection, cases, full_memory, with_key
from filter import FilterConfig
from monitor import Monitor
from server.keeper import KEY_BYTES
from server.live import Hub
from server.observer import Answered
from server.operation import Operation
from server.schema import ActRequest
from server.view import Views

FloatArray = NDArray[np.float64]

_QUANTILES = (50.0, 99.0, 99.9)


@dataclass(frozen=True)
class LiveBenchmark(RecordingBenchmark):
    """Measures POST /act with and without a watcher."""

    requests: int = 2000
    """Requests a round: long enough for some updates."""
    rounds: int = 30
    """Rounds of each kind."""


@contextmanager
def watched(url: str) -> Iterator[None]:
    """Somebody watches; the first update has come."""
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port), timeout=10.0) as stream:
        stream.sendall(f"GET /live HTTP/1.1\r\nhost: {address.netloc}\r\n\r\n".encode())
        seen = b""
        while b'"looked"' not in seen:
            seen += stream.recv(65536)
        yield
        stream.setblocking(False)
        if not stream.recv(65536):
            raise RuntimeError("the service ended the stream")


def run(config: LiveBenchmark) -> dict[str, dict[str, FloatArray]]:
    """Case → "alone" and "watched" → time of each request [µs], (rounds, requests)."""
    monitor = Monitor.load(config.bundle, config.gate)
    level, key = monitor.bundle.manifest.level, secrets.token_bytes(KEY_BYTES)
    measured = {}
    with with_key(config.bundle, config.gate, key) as service:
        for name, case in cases(level, full_memory(monitor, key)).items():
            connection = Connection(f"{service.url}/act", *bodies(level, case.asked))
            connection.times(500)
            taken: dict[str, list[list[float]]] = {"alone": [], "watched": []}
            for round_ in range(config.rounds):
                for kind in list(taken)[:: 1 if round_ % 2 else -1]:
                    if kind == "alone":
                        taken[kind].append(times(connection, config.requests, config.pace))
                        continue
                    with watched(service.url):
                        taken[kind].append(times(connection, config.requests, config.pace))
            connection.close()
            measured[name] = {kind: np.array(rows) for kind, rows in taken.items()}
    return measured


def noted(config: LiveBenchmark, calls: int = 5000, rounds: int = 20) -> float:
    """What the hub adds to a decision while nobody watches [µs]."""
    monitor = Monitor.load(config.bundle, config.gate)
    hub = Hub(Views(monitor, FilterConfig()), Operation(monitor), {})
    observation: list[float] = cases(monitor.bundle.manifest.level, "")["nominal"].asked["observation"]
    asked = ActRequest(observation=observation, robot="ada")
    one: Any = Answered(0, ("h", 1), "/act", b"", 1e-3, 200, b"", [asked], [monitor.decide(observation)])
    taken = []
    for _ in range(rounds):
        started = time.perf_counter()
        for _ in range(calls):
            hub.answered(one)
        taken.append((time.perf_counter() - started) / calls)
    return min(taken) * 1e6  # what the machine does besides only adds


def main() -> None:
    """Entry point of `python -m benchmarks.live`."""
    config = tyro.cli(LiveBenchmark, prog="python -m benchmarks.live")
    table = Table("POST /act", "", *(f"p{q:g} [µs]" for q in _QUANTILES), "watched: slower by (95 %)")
    for name, both in run(config).items():
        for kind, taken in both.items():
            quantiles = (f"{value:,.0f}" for value in np.percentile(taken, _QUANTILES))
            by = slower(*(np.median(both[k], axis=1) for k in ("alone", "watched")))
            table.add_row(name if kind == "alone" else "", kind, *quantiles, by if kind == "watched" else "")
    console = Console(width=120)
    console.print(table)
    console.print(f"the hub takes note of a decision in {noted(config):.2f} µs")


if __name__ == "__main__":
    main()
