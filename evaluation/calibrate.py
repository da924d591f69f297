"""The command `lagnet-calibrate`: chooses a bundle's gate in the closed loop, or measures λ as a warning."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import Progress

from command import command, progress_bar, settings, terminal, why_not_folder
from decision import MOST_OPEN, OpenedBy
from evaluation.closed_loop import HazardSource, TaskError, run_episodes
from evaluation.errors import CalibrateError
from evaluation.sequence import last_to_pass, most_missed
from evaluation.tables import table_console
from guide import DEFAULT_STRENGTH, Strength
from models import Bundle, BundleError, Calibration, Manifest, write_bundle
from monitor import Gate, Monitor, MonitorError
from pointgoal.loop import SIDE_BY_SIDE
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS

ENOUGH = 10_000
"""Episodes up to which is said how many are needed."""


@dataclass(frozen=True)
class CalibrateConfig:
    """Chooses when a bundle's gate opens, and writes it into the bundle; or measures how well λ warns.

    Gates are tried in the order of --thresholds, from the most open one on, each on fresh episodes in the
    closed loop. An episode is missed if the barrier's floor had to open the gate before λ did. The last gate
    before the first that misses too many is taken. With --report nothing is written into the bundle.
    """

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder, for example models/NAME."""
    miss_rate: float = 0.01
    """Largest probability that an episode is missed."""
    confidence: float = 0.95
    """How sure that has to be."""
    episodes: int = 1000
    """Episodes that each gate is tried on."""
    thresholds: tuple[float, ...] = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3)
    """Risk scores above which the gates open, in rising order."""
    hysteresis: float = 0.33
    """An open gate stays open while the risk score is above this share of the threshold."""
    dwell: int = 6
    """For how many control steps after that it still stays open."""
    hazards: HazardSource = "lidar"
    """What the filter knows of the hazards."""
    guide: Strength = DEFAULT_STRENGTH
    """How much the guide may do."""
    seed: int = 0
    """Seed of the episodes' layouts."""
    processes: int = 0
    """How many run side by side; 0: one a CPU."""
    report: Path | None = None
    """Folder for a table, figures and a picture of how well λ warns."""


@dataclass(frozen=True)
class Tried:
    """What a gate did in its episodes.

    Attributes:
        gate: the gate.
        missed: episodes in which the floor opened it before λ did; without a floor, in which the robot had a
            violation.
        violated: episodes with a violation.
        open: share of the steps on which it was open.
        returns: mean return.
    """

    gate: Gate
    missed: int
    violated: int
    open: float
    returns: float


def calibrate(config: CalibrateConfig, console: Console) -> tuple[Manifest, list[Tried]]:
    """Chooses the gate, and writes it into the bundle.

    Returns:
        The bundle's new manifest, and what each gate that was tried did; the last of them, without its
        floor, is the one that was taken.

    Raises:
        CalibrateError: for settings that promise nothing, or if no gate does what was asked.
        BundleError, MonitorError: if the bundle cannot be used.
    """
    bundle = Bundle.load(config.bundle)
    gates = _gates(config)
    allowed = _allowed(config)
    tried: list[Tried] = []
    with progress_bar(console) as bar, _workers(config) as run:

        def passes(gate: Gate) -> bool:
            job = bar.add_task(f"threshold {gate.threshold:g}", total=config.episodes)
            tried.append(run(gate, len(tried), _advance(bar, job)))
            return tried[-1].missed <= allowed

        chosen = last_to_pass(gates, passes)
        if chosen is None:
            found = tried[0]
            raise CalibrateError(
                f"no gate: the most open one, with threshold {found.gate.threshold:g}, missed {found.missed} "
                f"of {config.episodes} episodes, at most {allowed} may be; begin --thresholds lower, or fit "
                "λ anew"
            )
        job = bar.add_task("without the floor", total=config.episodes)
        bare = Gate("risk", chosen.threshold, chosen.hysteresis, chosen.dwell, floor=False)
        alone = run(bare, len(gates), _advance(bar, job))
    kept = next(one for one in tried if one.gate == chosen)
    calibration = Calibration(
        method="closed loop",
        miss_rate=config.miss_rate,
        confidence=config.confidence,
        episodes=config.episodes,
        missed=kept.missed,
        violated_without_floor=alone.violated,
        hazards=config.hazards,
        tried=len(tried),
        seed=config.seed,
        multiplier=bundle.manifest.sha256["multiplier.onnx"],
    )
    manifest = bundle.manifest.model_copy(
        update={
            "threshold": chosen.threshold,
            "hysteresis": chosen.hysteresis,
            "dwell": chosen.dwell,
            "threshold_source": _source(calibration),
            "calibration": calibration,
        }
    )
    written = write_bundle(bundle.path, bundle.policy, bundle.multiplier, manifest, bundle.novelty)
    return written.manifest, [*tried, alone]


def _source(c: Calibration) -> str:
    return (
        f"closed loop, hazards {c.hazards}: of {c.episodes} fresh episodes {c.missed} were missed, at most "
        f"{c.miss_rate:.2%} are, confidence {c.confidence:.0%}; fixed sequence of {c.tried} gates"
    )


def _gates(config: CalibrateConfig) -> list[Gate]:
    rising = config.thresholds
    if not rising or any(a >= b for a, b in pairwise(rising)):
        raise CalibrateError(f"--thresholds must rise, from the most open gate on, got {list(rising)}")
    if not 0 <= config.dwell <= MOST_OPEN:
        raise CalibrateError(f"--dwell must be 0 to {MOST_OPEN}, got {config.dwell}")
    return [Gate("risk", threshold, config.hysteresis, config.dwell) for threshold in rising]


def _allowed(config: CalibrateConfig) -> int:
    for flag, value in (("--miss-rate", config.miss_rate), ("--confidence", config.confidence)):
        if not 0.0 < value < 1.0:
            raise CalibrateError(f"{flag} must be between 0 and 1, got {value}")
    if config.episodes < 1 or config.processes < 0 or config.seed < 0:
        raise CalibrateError("--episodes must be at least 1, --processes and --seed at least 0")
    allowed = most_missed(config.episodes, config.miss_rate, config.confidence)
    if allowed < 0:
        needed = range(config.episodes, ENOUGH)
        least = next((n for n in needed if most_missed(n, config.miss_rate, config.confidence) >= 0), None)
        least_said = f"more than {ENOUGH}" if least is None else f"{least}"
        raise CalibrateError(
            f"--episodes {config.episodes} can show no miss rate of {config.miss_rate:g} with confidence "
            f"{config.confidence:g}, whatever the gate: {least_said} are needed"
        )
    return allowed


def _advance(bar: Progress, job: object) -> Callable[[int], None]:
    return lambda episodes: bar.advance(job, episodes)  # type: ignore[arg-type]


@contextmanager
def _workers(config: CalibrateConfig) -> Iterator[Callable[[Gate, int, Callable[[int], None]], Tried]]:
    """Runs a gate's episodes, those of the number-th `episodes` of the seed, in several processes."""
    count = config.processes or os.cpu_count() or 1
    with ProcessPoolExecutor(count, get_context("spawn")) as pool:

        def run(gate: Gate, number: int, done: Callable[[int], None]) -> Tried:
            starts = range(0, config.episodes, SIDE_BY_SIDE)
            parts = [
                pool.submit(
                    _episodes,
                    config,
                    gate,
                    number * config.episodes + start,
                    min(SIDE_BY_SIDE, config.episodes - start),
                )
                for start in starts
            ]
            found = []
            for part in as_completed(parts):
                found.append(part.result())
                done(found[-1][0])
            episodes, missed, violated, opened, returns = (sum(column) for column in zip(*found, strict=True))
            return Tried(
                gate, int(missed), int(violated), opened / episodes / EPISODE_STEPS, returns / episodes
            )

        yield run


@lru_cache(maxsize=1)
def _monitor(bundle: Path, gate: Gate, guide: Strength) -> Monitor:
    """One a process: a gate's parts come one after the other."""
    return Monitor.load(bundle, gate, guide=guide)


def _episodes(
    config: CalibrateConfig, gate: Gate, first: int, count: int
) -> tuple[int, int, int, float, float]:
    """Episodes, those missed, those with a violation, open steps and summed return of one part."""
    monitor = _monitor(config.bundle, gate, config.guide)
    task = monitor.bundle.manifest.task
    done = run_episodes(task, monitor, count, config.seed, config.hazards, use=Use.GATE, first=first)
    missed = done.opened_by[OpenedBy.BARRIER] > 0
    return (
        count,
        int(missed.sum()),
        int((done.violating_steps > 0).sum()),
        float(done.open_steps.sum()),
        float(done.returns.sum()),
    )


def main() -> None:
    """Entry point of `lagnet-calibrate`: exit status 0; 2 if nothing could be promised as asked."""
    expected = CalibrateError, TaskError, BundleError, MonitorError
    with command("lagnet-calibrate", *expected):
        config = settings(CalibrateConfig, "lagnet-calibrate")
        console = terminal()
        if config.report is not None:
            from evaluation.warning import report

            if why := why_not_folder(config.report):
                raise CalibrateError(f"--report {config.report}: {why}")
            table_console().print(report(config, console))
            return
        manifest, tried = calibrate(config, console)
        for one in tried:
            floor = "" if one.gate.floor else ", without its floor"
            console.print(
                f"threshold {one.gate.threshold:g}{floor}: missed {one.missed}, violated {one.violated} of "
                f"{config.episodes}; open on {one.open:.1%} of the steps; return {one.returns:.2f}"
            )
        console.print(f"{config.bundle}: threshold {manifest.threshold:g}: {manifest.threshold_source}")


if __name__ == "__main__":
    main()
