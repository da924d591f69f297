"""The command `lagnet-evaluate`."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from evaluation.closed_loop import Episodes, HazardSource, TaskError, run_episodes
from evaluation.deciders import Decider, InProcess, OverHttp
from evaluation.progress import progress_bar
from evaluation.statistics import Summary, summarise
from evaluation.tables import summary_table
from models import Bundle, BundleError
from monitor import Gate, Monitor, MonitorError
from pointgoal.observation import layout
from pointgoal.simulation import EPISODE_STEPS
from server import ClientError
from server.serve import ServeError, read_api_key


class EvaluateError(ValueError):
    """An evaluation that cannot be run as asked."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Runs a bundle in simulation and prints what became of the robots.

    Without --url the decisions are made in this process, all robots at once. With --url they are asked of a
    running `lagnet-serve`, one connection a robot; gate and threshold are then the service's, and one that is
    given here must be the same.
    """

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder, for example models/NAME."""
    episodes: int = 100
    """How many episodes."""
    gate: Gate | None = None
    """When the filter is active: where the risk score exceeds the threshold (the default), always, never."""
    threshold: float | None = None
    """Risk score above which the gate `risk` activates the filter; by default the bundle's."""
    hazards: HazardSource = "given"
    """What the filter knows of the hazards: their places in the body frame, or the lidar alone."""
    task: str | None = None
    """Gymnasium id of the task; by default the bundle's."""
    seed: int = 0
    """Seed of the episodes' layouts; another one has none of them in common."""
    url: str | None = None
    """A running service to ask, for example http://127.0.0.1:8000."""
    timeout: float = 1.0
    """With --url: how long a robot waits for its action [s]."""
    api_key_file: Path | None = None
    """With --url: file that holds the key; otherwise the environment variable LAGNET_API_KEY."""
    json: Path | None = None
    """File for the figures."""


def evaluate(config: EvaluateConfig, console: Console) -> tuple[Summary, Episodes, dict[str, Any]]:
    """Runs the episodes.

    Returns:
        The figures, the episodes, and what decided: model, gate, threshold.

    Raises:
        EvaluateError: for settings that make no evaluation.
        BundleError, MonitorError, ClientError, ServeError: if what decides cannot be used.
    """
    if config.episodes < 1 or config.seed < 0:
        raise EvaluateError("--episodes must be at least 1 and --seed at least 0")
    if not (math.isfinite(config.timeout) and config.timeout > 0.0):
        raise EvaluateError(f"--timeout must be finite and positive, got {config.timeout}")
    if config.json is not None and not config.json.parent.is_dir():
        raise EvaluateError(f"--json {config.json}: there is no folder {config.json.parent}")
    bundle = Bundle.load(config.bundle)
    bar = progress_bar(console)
    with bar, _decider(config, bundle) as (decider, who):
        task = config.task or bundle.manifest.task
        job = bar.add_task(task, total=config.episodes * EPISODE_STEPS)

        def advance(steps: int) -> None:
            bar.advance(job, steps)

        episodes = run_episodes(task, decider, config.episodes, config.seed, config.hazards, progress=advance)
    return summarise(episodes), episodes, who


@contextmanager
def _decider(config: EvaluateConfig, bundle: Bundle) -> Iterator[tuple[Decider, dict[str, Any]]]:
    """Who decides, and how it calls itself: model, gate, threshold."""
    if config.url is None:
        monitor = Monitor.load(config.bundle, config.gate or "risk", config.threshold)
        yield InProcess(monitor), {"model": bundle.id, "gate": monitor.gate, "threshold": monitor.threshold}
        return
    key = read_api_key(config.api_key_file)
    with OverHttp(config.url, layout(bundle.manifest.level).to_json(), config.timeout, key) as decider:
        served = decider.connect()
        if served.model != bundle.id:
            raise EvaluateError(f"{config.url} serves {served.model}, not {bundle.id}")
        if config.gate not in (None, served.gate):
            raise EvaluateError(f"{config.url} has gate {served.gate}, not {config.gate}")
        if config.threshold not in (None, served.threshold):
            raise EvaluateError(f"{config.url} has threshold {served.threshold}, not {config.threshold}")
        yield decider, {"model": served.model, "gate": served.gate, "threshold": served.threshold}


def write_json(
    path: Path, config: EvaluateConfig, who: dict[str, Any], summary: Summary, episodes: Episodes
) -> None:
    """Writes the figures, and each episode's, as JSON.

    Raises:
        EvaluateError: if the file cannot be written.
    """
    asked = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    each = {
        "return": episodes.returns.tolist(),
        "cost": episodes.costs.tolist(),
        "violating_steps": episodes.violating_steps.tolist(),
        "steps": episodes.steps.tolist(),
    }
    content = {"asked": asked, "decided_by": who, "summary": summary.to_json(), "each_episode": each}
    try:
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise EvaluateError(f"--json {path}: cannot be written: {error.strerror or error}") from error


def _title(config: EvaluateConfig, who: dict[str, Any]) -> str:
    gate = f"gate {who['gate']}, threshold {who['threshold']:.4g}"
    return f"{who['model']}, {gate}, hazards {config.hazards}, {config.url or 'in process'}"


def main() -> None:
    """Entry point of `lagnet-evaluate`: exit status 0, or 2 if it could not be run as asked."""
    config = tyro.cli(EvaluateConfig, prog="lagnet-evaluate")
    console = Console()
    try:
        summary, episodes, who = evaluate(config, console)
        console.print(summary_table(_title(config, who), {f"{summary.episodes} episodes": summary}))
        for reason, count in summary.reasons.items():
            console.print(f"  fallback × {count}: {reason}", markup=False)
        if config.json is not None:
            write_json(config.json, config, who, summary, episodes)
    except (EvaluateError, TaskError, BundleError, MonitorError, ClientError, ServeError) as error:
        Console(stderr=True).print(f"lagnet-evaluate: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
