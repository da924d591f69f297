"""The command `lagnet-evaluate`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from command import command, progress_bar, settings, why_not_file, why_not_folder
from decision import BatchDecider
from evaluation.closed_loop import Episodes, HazardSource, TaskError, run_episodes
from evaluation.errors import EvaluateError, ServiceError, ServiceGoneError
from evaluation.statistics import summarise
from evaluation.tables import table_console, tables
from guide import DEFAULT_STRENGTH, Strength
from models import Bundle, BundleError
from monitor import GateName, Monitor, MonitorError
from pointgoal.observation import layout
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS

Runs = dict[HazardSource, Episodes]
"""Where the filter had the hazards from → the episodes."""
_LABELS: dict[HazardSource, str] = {"lidar": "lidar alone", "given": "hazards given"}


@dataclass(frozen=True)
class EvaluateConfig:
    """Runs a bundle in simulation and prints what became of the robots.

    Without --url the decisions are made in this process, all robots at once. With --url they are asked of a
    running `lagnet-serve`, one connection a robot; gate, threshold and guide are then the service's, and what
    is given here must be the same.
    """

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder, for example models/NAME."""
    episodes: int = 100
    """How many episodes."""
    gate: GateName | None = None
    """When the filter is active: where the risk score or the barrier asks for it (default), always, never."""
    threshold: float | None = None
    """Risk score above which the gate `risk` activates the filter; by default the bundle's."""
    floor: bool = True
    """Whether the gate `risk` opens where the barrier is low, whatever λ says. Without, nothing is certified
    where λ is silent: to measure what λ is worth."""
    guide: Strength | None = None
    """How much the guide may do: nothing, lead from a refused action on, lead ahead (the default)."""
    hazards: Literal["lidar", "given", "both"] = "lidar"
    """What the filter knows of the hazards. A PointGoal task promises a robot its lidar alone; given: their
    places in the body frame as well; both: the same episodes with either."""
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
    figure: Path | None = None
    """Folder for the paper's figures 5 and 6, of one episode without filter; nothing else is run then."""


def evaluate(config: EvaluateConfig, console: Console) -> tuple[Runs, dict[str, Any]]:
    """Runs the episodes.

    Returns:
        The episodes by the hazards' source, and what decided: model, gate, threshold, guide.

    Raises:
        EvaluateError: for settings that make no evaluation.
        BundleError, MonitorError, ServiceError: if what decides cannot be used.
        ServiceGoneError: if the service stopped answering on the way.
    """
    if config.episodes < 1 or config.seed < 0:
        raise EvaluateError("--episodes must be at least 1 and --seed at least 0")
    if not (math.isfinite(config.timeout) and config.timeout > 0.0):
        raise EvaluateError(f"--timeout must be finite and positive, got {config.timeout}")
    if config.json is not None and (why := why_not_file(config.json)):
        raise EvaluateError(f"--json {config.json}: {why}")
    bundle = Bundle.load(config.bundle)
    task = config.task or bundle.manifest.task
    sources: tuple[HazardSource, ...] = ("lidar", "given") if config.hazards == "both" else (config.hazards,)
    bar = progress_bar(console)
    runs: Runs = {}
    with bar, _decider(config, bundle) as (decider, who):
        for source in sources:
            job = bar.add_task(f"{task}, {_LABELS[source]}", total=config.episodes * EPISODE_STEPS)
            advance = partial(bar.advance, job)
            runs[source] = run_episodes(
                task, decider, config.episodes, config.seed, source, progress=advance, use=Use.EVALUATION
            )
    return runs, who


@contextmanager
def _decider(config: EvaluateConfig, bundle: Bundle) -> Iterator[tuple[BatchDecider, dict[str, Any]]]:
    """What decides, and how it calls itself: model, gate, threshold, guide."""
    if config.url is None:
        guide = config.guide or DEFAULT_STRENGTH
        monitor = Monitor.load(bundle, config.gate or "risk", config.threshold, guide=guide)
        gate = monitor.gate = replace(monitor.gate, floor=config.floor)
        yield monitor, {"model": bundle.id, "gate": gate.name, "threshold": gate.threshold, "guide": guide}
        return
    if not config.floor:
        raise EvaluateError("--no-floor is not for a service: its gate has a floor")
    from evaluation.remote import asked

    wanted = layout(bundle.manifest.level).to_json()
    with asked(config.url, wanted, config.timeout, config.api_key_file) as (decider, served):
        who = {name: getattr(served, name) for name in ("model", "gate", "threshold", "guide")}
        if who["model"] != bundle.id:
            raise EvaluateError(f"{config.url} serves {who['model']}, not {bundle.id}")
        for name in ("gate", "threshold", "guide"):
            if getattr(config, name) not in (None, who[name]):
                raise EvaluateError(f"{config.url} has {name} {who[name]}, not {getattr(config, name)}")
        yield decider, who


def write_json(path: Path, config: EvaluateConfig, who: dict[str, Any], runs: Runs) -> None:
    """Writes the figures, and each episode's, as JSON.

    Raises:
        EvaluateError: if the file cannot be written.
    """
    asked = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    figures = {
        source: {"summary": summarise(episodes).to_json(), "each_episode": _each(episodes)}
        for source, episodes in runs.items()
    }
    content = {"asked": asked, "decided_by": who, "hazards": figures}
    try:
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise EvaluateError(f"--json {path}: cannot be written: {error.strerror or error}") from error


def _each(episodes: Episodes) -> dict[str, Any]:
    return {
        "return": episodes.returns.tolist(),
        "cost": episodes.costs.tolist(),
        "violating_steps": episodes.violating_steps.tolist(),
        "steps": episodes.steps.tolist(),
        "open_steps": episodes.open_steps.tolist(),
        "interventions": episodes.interventions.tolist(),
    }


def _figures(bundle: Path, seed: int, folder: Path, console: Console) -> None:
    from evaluation.figures import write_figures

    if why := why_not_folder(folder):
        raise EvaluateError(f"--figure {folder}: {why}")
    episode = write_figures(Bundle.load(bundle), seed, folder)
    console.print(
        f"{folder / 'figure5.png'}: return {episode.reward.sum():.1f}, depth cost {episode.cost.sum():.2f}, "
        f"λ from {episode.risk.min():.3g} to {episode.risk.max():.3g}"
    )
    console.print(f"{folder / 'figure6.png'}: the moments of the stars")


def _title(config: EvaluateConfig, who: dict[str, Any]) -> str:
    return (
        f"{who['model']}, {config.episodes} episodes, {config.url or 'in process'}\n"
        f"gate {who['gate']}, threshold {who['threshold']:.4g}, guide {who['guide']}"
    )


def main() -> None:
    """Entry point of `lagnet-evaluate`.

    Exit status 0; 1 if the service failed on the way; 2 if nothing could be run as asked.
    """
    expected = EvaluateError, TaskError, BundleError, MonitorError, ServiceError
    with command("lagnet-evaluate", *expected), command("lagnet-evaluate", ServiceGoneError, status=1):
        config = settings(EvaluateConfig, "lagnet-evaluate")
        console = table_console()
        if config.figure is not None:
            _figures(config.bundle, config.seed, config.figure, console)
            return
        runs, who = evaluate(config, console)
        summaries = {_LABELS[source]: summarise(episodes) for source, episodes in runs.items()}
        console.print(tables(_title(config, who), summaries))
        for label, summary in summaries.items():
            for reason, count in summary.reasons.items():
                console.print(f"{label}: fallback × {count}: {reason}")
        if config.json is not None:
            write_json(config.json, config, who, runs)


if __name__ == "__main__":
    main()
