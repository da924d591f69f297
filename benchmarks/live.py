"""What the live page costs `POST /act`: two services, one of which is watched, asked in turn.

    python -m benchmarks.live models/NAME

A process of its own reads the stream of the watched one and looks at the robot that asks. Rounds alternate, as
in `benchmarks.recording`, whose table this is. What is told last is what the hub adds to a decision while
nobody watches.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import ExitStack
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.recording import Measured, RecordingBenchmark, alternate, bodies, slower
from benchmarks.server import cases
from evaluation.service import Service
from filter import FilterConfig
from models import Bundle
from monitor import Monitor
from server.app import Lifecycle, Standing
from server.live import Hub
from server.observer import Answered
from server.schema import ActRequest
from server.view import Views

_READ = "import sys, urllib.request as u; s = u.urlopen(sys.argv[1])\nwhile s.read1(65536): pass"


def run(config: RecordingBenchmark) -> dict[str, dict[str, Measured]]:
    """What was measured by case and service."""
    level = Bundle.load(config.bundle).manifest.level
    command = [sys.executable, "-m", "server.serve", str(config.bundle), "--port", "0", "--gate", config.gate]
    with ExitStack() as stack:
        services = {
            "alone": stack.enter_context(Service.run(command)),
            "watched": stack.enter_context(Service.run(command)),
        }
        reader = subprocess.Popen([sys.executable, "-c", _READ, f"{services['watched'].url}/live"])
        stack.callback(reader.terminate)
        time.sleep(1.0)
        measured = {
            name: alternate(services, bodies(level, case.asked), config)
            for name, case in cases(level).items()
        }
        if reader.poll() is not None:
            raise RuntimeError("nobody watched to the end")
    return measured


def noted(config: RecordingBenchmark, calls: int = 100_000) -> float:
    """What the hub adds to a decision [µs], without the call itself of a decision."""
    monitor = Monitor.load(config.bundle, config.gate)
    hub = Hub(Views(monitor, FilterConfig()), Standing(Lifecycle(), monitor), {})
    observation: list[float] = cases(monitor.bundle.manifest.level)["nominal"].asked["observation"]
    asked = ActRequest(observation=observation, robot="ada")
    one: Any = Answered(0, ("h", 1), "/act", b"", 1e-3, 200, b"", [asked], [monitor.decide(observation)])
    times = []
    for _ in range(20):
        started = time.perf_counter()
        for _ in range(calls // 20):
            hub.answered(one)
        times.append((time.perf_counter() - started) / (calls // 20))
    return float(np.median(times)) * 1e6


def main() -> None:
    """Entry point of `python -m benchmarks.live`."""
    config = tyro.cli(RecordingBenchmark, prog="python -m benchmarks.live")
    table = Table("POST /act", "", "median [µs]", "slower by (95 %)", "p99 [µs]", "p99 / alone")
    for name, both in run(config).items():
        alone = both["alone"]
        for kind, one in both.items():
            watched = kind == "watched"
            p99 = np.percentile(one.taken, 99)
            table.add_row(
                "" if watched else name,
                kind,
                f"{np.median(one.taken):,.0f}",
                slower(np.median(alone.taken, axis=1), np.median(one.taken, axis=1)) if watched else "",
                f"{p99:,.0f}",
                f"{p99 / np.percentile(alone.taken, 99):.2f}" if watched else "",
            )
    console = Console(width=120)
    console.print(table)
    console.print(f"the hub takes note of a decision in {noted(config):.2f} µs")


if __name__ == "__main__":
    main()
