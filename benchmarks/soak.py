"""Robots that drive through one service for long: what it remembers, forgets and loses on the way.

    python -m benchmarks.soak models/NAME --minutes 60

They drive in MuJoCo, each by `POST /act`, episode after episode. The service records, is scraped once a
second and is watched as the live page watches. Told are its memory over time, what its clients had to do
without, violating steps, and whether metrics and recordings have counted every decision.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any
from urllib.request import urlopen

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from decision import MEMORY
from evaluation.service import Service
from pointgoal import seeds
from pointgoal.loop import drive
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv
from server.fleet import Fleet

_SETTLED = 0.25
"""The share of the time after which memory counts: what is learnt once is learnt by then."""


@dataclass(frozen=True)
class SoakBenchmark:
    """Drives robots through a service for long."""

    bundle: Annotated[Path, tyro.conf.Positional] = Path("models/pointgoal1")
    """The bundle's folder."""
    minutes: float = 10.0
    """For how long [min]."""
    robots: int = 8
    """How many drive at once."""
    timeout: float = 1.0
    """How long a robot waits for its action [s]; late replies are no matter here, lost ones are."""
    seed: int = 0
    """Seed of the layouts."""


@dataclass
class Soaked:
    """What came of it.

    Attributes:
        memory: of the service, once a second: seconds, decisions so far, [MB], and what of it waits to be
            recorded [MB].
        decisions: how many were asked for.
        seconds: for how long.
        faults: of the clients, by kind.
        violating_steps: how many.
        counted: decisions by the service's metrics.
        recorded: by its recording.
        complaints: what the service wrote to its standard error.
    """

    memory: list[tuple[float, int, float, float]] = field(default_factory=list)
    decisions: int = 0
    seconds: float = 0.0
    faults: dict[str, int] = field(default_factory=dict)
    violating_steps: int = 0
    counted: int = 0
    recorded: int = 0
    complaints: str = ""

    @property
    def growth(self) -> float:
        """How much the memory grew once settled, by a straight line [MB a million decisions].

        What waits to be recorded is bounded, comes and goes, and is left out.
        """
        settled = np.array([row for row in self.memory if row[0] >= _SETTLED * self.seconds])
        if len(settled) < 3:
            return float("nan")
        return float(np.polyfit(settled[:, 1] / 1e6, settled[:, 2] - settled[:, 3], 1)[0])


def resident(process: int) -> float:
    """Memory that a process holds [MB], on Linux."""
    status = Path(f"/proc/{process}/status").read_text()
    found = re.search(r"^VmRSS:\s+(\d+) kB", status, re.MULTILINE)
    return int(found.group(1)) / 1e3 if found else float("nan")


def soak(config: SoakBenchmark) -> Soaked:
    """Drives, and looks at the service meanwhile."""
    came, over = Soaked(), threading.Event()
    with ExitStack() as stack:
        tapes = stack.enter_context(tempfile.TemporaryDirectory())
        command = [sys.executable, "-m", "server.serve", str(config.bundle), "--port", "0"]
        service = stack.enter_context(
            Service.run([*command, "--record", tapes, "--record-mb", "64", "--record-file-mb", "16"])
        )
        begun = time.monotonic()
        watchers = [
            threading.Thread(target=_look, args=(service, came, begun, over)),
            threading.Thread(target=_watch, args=(service.url, over)),
        ]
        for watcher in watchers:
            watcher.start()
        try:
            _drive(service.url, config, came, begun)
        finally:
            over.set()
            for watcher in watchers:
                watcher.join()
        came.seconds = time.monotonic() - begun
        came.counted = _counted(service.url)
        came.recorded = _recorded(service.url, came.decisions)
        came.complaints = service.complaints()
    return came


def _drive(url: str, config: SoakBenchmark, came: Soaked, begun: float) -> None:
    env = PointGoalVectorEnv(level=1, num_envs=config.robots, num_threads=1)
    end = begun + 60.0 * config.minutes
    with Fleet(url, timeout=config.timeout) as fleet:
        for episode in range(10**6):
            memory = np.zeros(config.robots, MEMORY)

            def act(observation: np.ndarray, env: PointGoalVectorEnv) -> np.ndarray:
                nonlocal memory
                decided = fleet.decide_batch(observation, None, memory)
                memory = decided.memory
                came.decisions += len(decided)
                return decided.action

            layouts = seeds.rows(Use.SOAK, config.seed + episode, config.robots)
            for step in drive(env, act, layouts):
                came.violating_steps += int((step.cost > 0.0).sum())
                if time.monotonic() >= end:
                    came.faults = dict(fleet.faults.counts)
                    env.close()
                    return


def _look(service: Service, came: Soaked, begun: float, over: threading.Event) -> None:
    """Notes the memory once a second, and scrapes the metrics."""
    while not over.wait(1.0):
        seconds, process = time.monotonic() - begun, service.process.pid
        waiting = _recording(service.url)["waiting"] / 1e6
        came.memory.append((seconds, came.decisions, resident(process), waiting))
        _counted(service.url)


def _watch(url: str, over: threading.Event) -> None:
    """Reads what the live page reads."""
    with urlopen(f"{url}/live") as stream:
        while not over.is_set() and stream.readline():
            pass


def _counted(url: str) -> int:
    with urlopen(f"{url}/metrics") as reply:
        lines = reply.read().decode().splitlines()
    return int(sum(float(line.split()[-1]) for line in lines if line.startswith("lagnet_decisions_total{")))


def _recorded(url: str, expected: int, patience: float = 10.0) -> int:
    """What the recording has taken; it is told a moment later."""
    end = time.monotonic() + patience
    while True:
        recorded = int(_recording(url).get("recorded", 0))
        if recorded >= expected or time.monotonic() > end:
            return recorded
        time.sleep(0.1)


def _recording(url: str) -> dict[str, Any]:
    """How the recording stands."""
    with urlopen(f"{url}/healthz") as reply:
        told: dict[str, Any] = json.load(reply)["recording"]
    return told


def main() -> None:
    """Entry point of `python -m benchmarks.soak`."""
    config = tyro.cli(SoakBenchmark, prog="python -m benchmarks.soak")
    came = soak(config)
    table = Table("", "")
    first, last = came.memory[0][2], came.memory[-1][2]
    waiting = max(row[3] for row in came.memory)
    grew = f"{first:.0f} at first, {last:.0f} at last; once settled {came.growth:+.1f} a million decisions"
    for name, value in (
        ("decisions", f"{came.decisions:,} in {came.seconds / 60.0:.1f} min"),
        ("memory [MB]", grew),
        ("violating steps", f"{came.violating_steps}"),
        ("clients' faults", json.dumps(came.faults)),
        ("counted by /metrics", f"{came.counted:,}"),
        ("recorded", f"{came.recorded:,}; at most {waiting:.1f} MB waited to be"),
        ("the service's complaints", came.complaints or "none"),
    ):
        table.add_row(name, value)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
