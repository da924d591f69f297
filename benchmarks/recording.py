"""What recording costs `POST /act`: two services, one of which records, asked in turn.

    python -m benchmarks.recording models/NAME

Rounds alternate between the two, and each is measured against the round beside it, so that what else the
machine does hits both. The services' processor time is told as well, without that of the recorder's process.
Every request has an observation of its own: recordings of one and the same compress to nothing. With `--pace`
a robot asks that often; with 0 it asks again as soon as it is answered.
"""

from __future__ import annotations

import json
import math
import secrets
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.request import urlopen

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.server import Connection, cases, full_memory
from evaluation.service import Service
from monitor import GateName, Monitor
from pointgoal.observation import layout
from server.keeper import KEY_BYTES

FloatArray = NDArray[np.float64]

_BODIES = 200


@dataclass(frozen=True)
class RecordingBenchmark:
    """Measures POST /act with and without --record."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder."""
    gate: GateName = "risk"
    """When the filter is active."""
    requests: int = 200
    """Requests a round."""
    rounds: int = 100
    """Rounds of each service."""
    pace: float = 0.0
    """Requests a second of the one robot; 0: as many as are answered."""


def bodies(level: int, asked: dict[str, Any]) -> list[bytes]:
    """Requests like one, each with other numbers in the blocks that no filter reads."""
    rng = np.random.default_rng(0)
    place = layout(level).slice("goal_lidar")
    made = []
    for number in range(_BODIES):
        observation = np.array(asked["observation"])
        observation[place] += rng.uniform(0.0, 1e-3, place.stop - place.start)
        made.append(json.dumps(asked | {"observation": observation.tolist(), "request": number}).encode())
    return made


def times(connection: Connection, requests: int, pace: float) -> list[float]:
    """Microseconds of each of some requests, one after the other."""
    taken = []
    due = time.perf_counter()
    for _ in range(requests):
        if pace:
            due += 1.0 / pace
            time.sleep(max(0.0, due - time.perf_counter()))
        started = time.perf_counter()
        connection.exchange()
        taken.append((time.perf_counter() - started) * 1e6)
    return taken


def processor_time(process: int) -> float:
    """What a process has used, all its threads together [µs]; NaN where the system does not tell."""
    threads = Path(f"/proc/{process}/task").glob("*/schedstat")
    used = [int(thread.read_text().split()[0]) for thread in threads]
    return sum(used) / 1e3 if used else math.nan


@dataclass(frozen=True)
class Measured:
    """One service in one case.

    Attributes:
        taken: time of each request [µs], (rounds, requests).
        used: processor time of the service a request [µs], (rounds,).
    """

    taken: FloatArray
    used: FloatArray


def alternate(
    services: dict[str, Service], made: list[bytes], config: RecordingBenchmark
) -> dict[str, Measured]:
    """Measures services in turn."""
    connections = {kind: Connection(f"{service.url}/act", *made) for kind, service in services.items()}
    taken: dict[str, list[list[float]]] = {kind: [] for kind in services}
    used: dict[str, list[float]] = {kind: [] for kind in services}
    for connection in connections.values():
        connection.times(100)
    for round_ in range(config.rounds):
        # Whoever is first finds the machine as the other left it: they take turns.
        for kind in list(services)[:: 1 if round_ % 2 else -1]:
            process = services[kind].process.pid
            before = processor_time(process)
            taken[kind].append(times(connections[kind], config.requests, config.pace))
            used[kind].append((processor_time(process) - before) / config.requests)
    for connection in connections.values():
        connection.close()
    return {kind: Measured(np.array(taken[kind]), np.array(used[kind])) for kind in services}


def run(config: RecordingBenchmark) -> tuple[dict[str, dict[str, Measured]], dict[str, Any], float]:
    """What was measured by case and service; how the recorder stands at the end; bytes a decision."""
    monitor = Monitor.load(config.bundle, config.gate)
    level, key = monitor.bundle.manifest.level, secrets.token_bytes(KEY_BYTES)
    command = [sys.executable, "-m", "server.serve", str(config.bundle), "--port", "0", "--gate", config.gate]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        key_file = Path(folder, "key")
        key_file.write_bytes(key)
        command += ["--memory-key-file", str(key_file)]
        services = {
            "without": stack.enter_context(Service.run(command)),
            "with": stack.enter_context(Service.run([*command, "--record", folder])),
        }
        measured = {
            name: alternate(services, bodies(level, case.asked), config)
            for name, case in cases(level, full_memory(monitor, key)).items()
        }
        time.sleep(1.0)
        with urlopen(f"{services['with'].url}/healthz") as reply:
            standing = json.loads(reply.read())["recording"]
        services["with"].stop()
        size = sum(path.stat().st_size for path in Path(folder).glob("recording-*.mcap"))
    return measured, standing, size / standing["recorded"]


def slower(without: FloatArray, with_: FloatArray) -> str:
    """By how much, round by round, and its 95 % interval: what the machine did meanwhile is in both."""
    ratios = with_ / without - 1.0
    drawn = np.median(np.random.default_rng(0).choice(ratios, (2000, len(ratios))), axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{np.median(ratios):+.1%} ({low:+.1%} to {high:+.1%})"


def main() -> None:
    """Entry point of `python -m benchmarks.recording`."""
    config = tyro.cli(RecordingBenchmark, prog="python -m benchmarks.recording")
    measured, standing, size = run(config)
    table = Table(
        "POST /act", "", "median [µs]", "slower by (95 %)", "p99 [µs]", "processor [µs]", "more by (95 %)"
    )
    for name, both in measured.items():
        plain, recording = both["without"], both["with"]
        for kind, one in both.items():
            last = kind == "with"
            table.add_row(
                name if not last else "",
                kind,
                f"{np.median(one.taken):,.0f}",
                slower(np.median(plain.taken, axis=1), np.median(one.taken, axis=1)) if last else "",
                f"{np.percentile(one.taken, 99):,.0f}",
                f"{np.median(one.used):,.0f}",
                slower(plain.used, recording.used) if last else "",
            )
    console = Console(width=140)
    console.print(table)
    console.print(
        f"{standing['recorded']:,} decisions recorded, {standing['dropped']:,} dropped, "
        f"{size:,.0f} bytes each on the disk"
    )


if __name__ == "__main__":
    main()
