"""Requests a second with one worker and with several, and on Ray Serve: beside each other, in turn.

    python -m benchmarks.fleet models/NAME [--ray]

The load comes from processes of its own, and takes cores too: on a machine with as many cores as workers the
figures say what is left, not what the workers could do.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.server import Case, Connection, cases, throughput
from decision import Mode
from evaluation.service import Service


@dataclass(frozen=True)
class FleetBenchmark:
    """Measures POST /act with several workers, and through Ray Serve."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder."""
    workers: tuple[int, ...] = (1, 2)
    """Numbers of workers."""
    ray: bool = False
    """Whether Ray Serve is measured too, one replica on this machine."""
    requests: int = 2000
    """Requests a round."""
    rounds: int = 5
    """Rounds; the median over rounds is printed."""
    clients: tuple[int, ...] = (1, 8, 64)
    """Connections at once."""
    generators: int = 2
    """Processes that the load comes from, where there are so many clients."""


def load(generators: Executor, processes: int, url: str, body: bytes, clients: int, requests: int) -> float:
    """Requests a second over several connections, from several processes."""
    share = [clients // processes + (i < clients % processes) for i in range(min(processes, clients))]
    return sum(generators.map(throughput, repeat(url), repeat(body), share, repeat(requests)))


def one_client(url: str, case: Case, requests: int) -> tuple[float, float]:
    """Median and 99th percentile of a call [µs]."""
    connection = Connection(url, case.body)
    assert json.loads(connection.exchange())["mode"] == case.mode
    connection.times(50)
    p50, p99 = np.percentile(connection.times(requests), [50, 99]) * 1e6
    connection.close()
    return float(p50), float(p99)


@contextmanager
def services(config: FleetBenchmark) -> Iterator[dict[str, Service]]:
    """What is measured, all of it running."""
    with ExitStack() as stack:
        started = {}
        for workers in config.workers:
            command = [sys.executable, "-m", "server.serve", str(config.bundle), "--port", "0"]
            service = Service.run([*command, "--workers", str(workers)])
            started[f"{workers} worker{'s' if workers > 1 else ''}"] = stack.enter_context(service)
        if config.ray:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = str(free.getsockname()[1])
            command = [sys.executable, "-m", "server.ray", str(config.bundle), "--port", port]
            service = Service.run([*command, "--max-replicas", "1"])
            started["Ray Serve, 1 replica"] = stack.enter_context(service)
        yield started


def main() -> None:
    """Entry point of `python -m benchmarks.fleet`."""
    config = tyro.cli(FleetBenchmark, prog="python -m benchmarks.fleet")
    seen: dict[str, list[list[float]]] = {}
    generators = ProcessPoolExecutor(config.generators, get_context("fork"))
    with generators, services(config) as started:
        case = Case(cases(1, "")["nominal"].asked, Mode.NOMINAL)
        for _ in range(config.rounds):
            for name, service in started.items():
                url = f"{service.url}/act"
                # A tenth of them: what Ray Serve takes for as many would be minutes.
                requests = config.requests // 10 if name.startswith("Ray") else config.requests
                rates = [
                    load(generators, config.generators, url, case.body, n, max(20, requests // n))
                    for n in config.clients
                ]
                seen.setdefault(name, []).append([*one_client(url, case, requests), *rates])
    table = Table("", "p50 [µs]", "p99 [µs]", "p50 / first")
    for clients in config.clients:
        table.add_column(f"requests/s, {clients} at once")
    first = 0.0
    for name, rows in seen.items():
        p50, p99, *rates = np.median(rows, axis=0).tolist()
        first = first or p50
        told = (f"{p50:,.0f}", f"{p99:,.0f}", f"{p50 / first:.2f}", *(f"{rate:,.0f}" for rate in rates))
        table.add_row(name, *told)
    console = Console(width=120)
    console.print(table)
    console.print(f"{os.cpu_count()} cores; load from {config.generators} more processes")


if __name__ == "__main__":
    main()
