"""What recording costs `POST /act`: two services, one of which records, asked in turn.

    python -m benchmarks.recording models/NAME

Rounds alternate between the two, and each is measured against the round beside it, so that what else the
machine does hits both. Every request has an observation of its own: recordings of one and the same compress
to nothing. With `--pace` a robot asks that often; with 0 it asks again as soon as it is answered.
"""

from __future__ import annotations

import json
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

from benchmarks.server import Connection, cases
from evaluation.service import Service
from models import Bundle
from monitor import GateName
from pointgoal.observation import layout

FloatArray = NDArray[np.float64]

_BODIES = 200


@dataclass(frozen=True)
class RecordingBenchmark:
    """Measures POST /act with and without --record."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder."""
    gate: GateName = "risk"
    """When the filter is active."""
    requests: int = 2000
    """Requests a round."""
    rounds: int = 10
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


def alternate(urls: dict[str, str], made: list[bytes], config: RecordingBenchmark) -> dict[str, FloatArray]:
    """Times [µs] of each service, (rounds, requests)."""
    connections = {kind: Connection(f"{url}/act", *made) for kind, url in urls.items()}
    taken: dict[str, list[list[float]]] = {kind: [] for kind in urls}
    for connection in connections.values():
        connection.times(100)
    for round_ in range(config.rounds):
        # Whoever is first finds the machine as the other left it: they take turns.
        for kind in list(urls)[:: 1 if round_ % 2 else -1]:
            taken[kind].append(times(connections[kind], config.requests, config.pace))
    for connection in connections.values():
        connection.close()
    return {kind: np.array(rounds) for kind, rounds in taken.items()}


def run(config: RecordingBenchmark) -> tuple[dict[str, dict[str, FloatArray]], dict[str, Any], float]:
    """Times [µs] by case and service; how the recorder stands at the end; bytes on the disk a decision."""
    level = Bundle.load(config.bundle).manifest.level
    command = [sys.executable, "-m", "server.serve", str(config.bundle), "--port", "0", "--gate", config.gate]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        plain = stack.enter_context(Service.run(command))
        recording = stack.enter_context(Service.run([*command, "--record", folder]))
        urls = {"without": plain.url, "with": recording.url}
        taken = {
            name: alternate(urls, bodies(level, case.asked), config) for name, case in cases(level).items()
        }
        time.sleep(1.0)
        with urlopen(f"{recording.url}/healthz") as reply:
            standing = json.loads(reply.read())["recording"]
        recording.stop()
        size = sum(path.stat().st_size for path in Path(folder).glob("recording-*.mcap"))
    return taken, standing, size / standing["recorded"]


def main() -> None:
    """Entry point of `python -m benchmarks.recording`."""
    config = tyro.cli(RecordingBenchmark, prog="python -m benchmarks.recording")
    taken, standing, size = run(config)
    table = Table(
        "POST /act", "median without [µs]", "with --record [µs]", "slower by", "95 %", "p99", "p99 with"
    )
    for name, both in taken.items():
        without, with_ = both["without"], both["with"]
        # Round by round: what the machine did meanwhile is in both.
        ratios = np.median(with_, axis=1) / np.median(without, axis=1) - 1.0
        rng = np.random.default_rng(0)
        drawn = np.median(rng.choice(ratios, (2000, len(ratios))), axis=1)
        low, high = np.percentile(drawn, [2.5, 97.5])
        table.add_row(
            name,
            f"{np.median(without):,.0f}",
            f"{np.median(with_):,.0f}",
            f"{np.median(ratios):+.1%}",
            f"{low:+.1%} to {high:+.1%}",
            f"{np.percentile(without, 99):,.0f}",
            f"{np.percentile(with_, 99):,.0f}",
        )
    console = Console(width=120)
    console.print(table)
    console.print(
        f"{standing['recorded']:,} decisions recorded, {standing['dropped']:,} dropped, "
        f"{size:,.0f} bytes each on the disk"
    )


if __name__ == "__main__":
    main()
