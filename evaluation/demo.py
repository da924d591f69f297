"""The demo: a service for each gate, robots driving through it, a table, pictures and an animation."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from command import command, progress_bar, settings, terminal
from evaluation.closed_loop import Episodes, HazardSource, run_episodes
from evaluation.errors import EvaluateError, ServiceError, ServiceGoneError
from evaluation.pictures import Drive, animate, draw_drives, drive
from evaluation.statistics import summarise
from evaluation.tables import TABLE_WIDTH, table_console, tables
from models import Bundle, BundleError
from monitor import GateName
from pointgoal.loop import SIDE_BY_SIDE
from pointgoal.observation import layout
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS

GATES: tuple[GateName, ...] = ("off", "risk", "always")
"""The gates that the demo drives through, in the order in which it shows them."""
WATCHED: GateName = "risk"
"""The gate under which the live page is watched."""
_HAZARDS = {"lidar": "by lidar alone", "given": "given"}


@dataclass(frozen=True)
class DemoConfig:
    """Drives a bundle through POST /act under every gate and shows what became of the robots.

    Each gate gets a `lagnet-serve` of its own on a free port, stopped at the end whatever happens.
    """

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder, for example models/NAME."""
    out: Path = Path("demo")
    """Folder for the table, the pictures and the animation."""
    episodes: int = 20
    """How many episodes for each gate, the same ones."""
    seed: int = 0
    """Seed of the episodes' layouts; another one has none of them in common."""
    hazards: HazardSource = "lidar"
    """What the filter knows of the hazards: the lidar alone, or their places in the body frame as well."""
    timeout: float = 1.0
    """How long a robot waits for its action [s]."""

    def check(self) -> None:
        """Raises EvaluateError for settings that make no demo."""
        if not 1 <= self.episodes <= SIDE_BY_SIDE or self.seed < 0:
            raise EvaluateError(f"--episodes must be 1 to {SIDE_BY_SIDE} and --seed at least 0")
        if not (math.isfinite(self.timeout) and self.timeout > 0.0):
            raise EvaluateError(f"--timeout must be finite and positive, got {self.timeout}")


def run_demo(config: DemoConfig, console: Console) -> None:
    """Runs the demo.

    Raises:
        EvaluateError: for settings that make no demo.
        BundleError, ServiceError: if a service cannot be had.
        ServiceGoneError: if one stopped answering on the way.
        OSError: if the folder cannot be written.
    """
    config.check()
    started = time.monotonic()
    bundle = Bundle.load(config.bundle)
    config.out.mkdir(parents=True, exist_ok=True)
    console.print(
        f"{bundle.id} on {bundle.manifest.task}, through POST /act, {config.episodes} robots at once"
    )
    runs, said = {}, []
    for gate in GATES:
        runs[gate], told = _drive_through(gate, bundle, config, console)
        said += told
    title = f"{config.episodes} episodes, hazards {_HAZARDS[config.hazards]}, over HTTP"
    show(runs, config.out, bundle.manifest.threshold, title, console)
    for line in said:
        console.print(line)
    console.print(f"to see it live: lagnet-serve {config.bundle}, and http://127.0.0.1:8000/ in a browser")
    console.print(f"done in {time.monotonic() - started:.0f} s")


def show(
    runs: Mapping[GateName, Episodes], out: Path, threshold: float, title: str, console: Console
) -> None:
    """Prints and writes what became of the robots: a table, figures, a picture and an animation.

    Args:
        runs: gate → recorded episodes, the same ones under each.
        out: the folder to write to.
        threshold: of the gate `risk`.
        title: of the table.
        console: to print to.
    """
    summaries = {gate: summarise(episodes) for gate, episodes in runs.items()}
    table = tables(title, {f"gate {gate}": summary for gate, summary in summaries.items()})
    console.print(table)
    figures = {gate: summary.to_json() for gate, summary in summaries.items()}
    (out / "summary.json").write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    with (out / "table.txt").open("w", encoding="utf-8") as file:
        terminal(stderr=False, file=file, width=TABLE_WIDTH).print(table)
    shown = choose_episode(runs["off"], runs["always"])
    drives: dict[str, Drive] = {
        gate: drive(episodes.trajectory, shown) for gate, episodes in runs.items() if episodes.trajectory
    }
    picture, animation = out / "episode.png", out / "episode.gif"
    headline = f"One robot, one policy, three gates: episode {shown + 1} of {len(runs['off'].returns)}"
    draw_drives(picture, drives, threshold, headline)
    animate(animation, {gate: drives[gate] for gate in ("off", "risk")})
    console.print(f"{picture}: the paths, and over time the gate, what was sent, λ, barrier and cost")
    console.print(f"{animation}: the same episode without and with the filter")


def _drive_through(
    gate: GateName, bundle: Bundle, config: DemoConfig, console: Console
) -> tuple[Episodes, list[str]]:
    """The episodes under one gate, through a service of its own; what is to be said of its page's picture."""
    from evaluation.camera import camera
    from evaluation.remote import asked
    from evaluation.service import Service

    bar = progress_bar(console)
    said: list[str] = []
    wanted = layout(bundle.manifest.level).to_json()
    with (
        bar,
        Service.start(config.bundle, gate) as service,
        asked(service.url, wanted, config.timeout) as (decider, _),
        camera(service.url, config.out / "live.png", said) if gate == WATCHED else nullcontext(),
    ):
        job = bar.add_task(f"gate {gate}", total=config.episodes * EPISODE_STEPS)
        episodes = run_episodes(
            bundle.manifest.task,
            decider,
            config.episodes,
            config.seed,
            config.hazards,
            record=True,
            progress=lambda steps: bar.advance(job, steps),
            use=Use.DEMO,
        )
    return episodes, said


def choose_episode(off: Episodes, always: Episodes) -> int:
    """The episode to show: among the better half with the filter, the one that needed it most."""
    good = always.returns >= np.median(always.returns)
    return int(np.argmax(np.where(good, off.violating_steps, -1)))


def _interrupt(number: int, frame: FrameType | None) -> None:
    """SIGTERM ends the demo as Ctrl-C does, so that the service is stopped on the way out."""
    raise KeyboardInterrupt


def main() -> None:
    """Entry point of `python -m evaluation.demo`."""
    signal.signal(signal.SIGTERM, _interrupt)
    expected = EvaluateError, BundleError, ServiceError, OSError
    with command("demo", *expected), command("demo", ServiceGoneError, status=1):
        run_demo(settings(DemoConfig, "python -m evaluation.demo"), table_console())


if __name__ == "__main__":
    main()
