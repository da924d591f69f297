"""The command `lagnet-calibrate`: chooses a bundle's gate, checks that choice, or measures λ as a warning."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, NamedTuple, Protocol

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import Progress

from command import command, progress_bar, settings, terminal, why_not_folder
from decision import Decisions, Memory, OpenedBy
from evaluation.closed_loop import HazardSource, TaskError, run_episodes
from evaluation.errors import CalibrateError
from evaluation.exchange import FloatArray, silence
from evaluation.recorded import barrier_filter, calibrate_on_logs, check_gate, check_logs, check_promise
from evaluation.sequence import last_to_pass
from evaluation.tables import table_console
from guide import DEFAULT_STRENGTH, Strength
from models import (
    MOST_SCORES,
    Bundle,
    BundleError,
    Calibration,
    Manifest,
    check_target,
    write_bundle,
)
from monitor import Gate, Monitor, MonitorError, NetworkError
from pointgoal.loop import SIDE_BY_SIDE
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS
from trainer.binomial import least_episodes, most_missed

NOT_AS_ASKED = 1
"""Exit status where a check finds that the calibration no longer applies."""


@dataclass(frozen=True)
class CalibrateConfig:
    """Chooses when a bundle's gate opens, and writes it into the bundle; or measures how well λ warns.

    Gates are tried in the order of --thresholds, from the most open one on, each on fresh episodes in the
    closed loop. An episode is missed if the barrier's floor had to open the gate before λ did. The last gate
    before the first that misses too many is taken. With --log the threshold is chosen from a robot's own
    episodes, recorded without a filter. With --check or --report nothing is written into the bundle.
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
    novelty: bool = False
    """Finds what is normal for the policy on its robot, by --episodes, half as many to learn from: above
    the limits that go with it the gate opens whatever λ says, or the robot stops."""
    log: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """An .npz with the arrays observation (T, O), cost (T,) and episode (T,); once for each log."""
    check: bool = False
    """Whether the logged episodes still look like those that the gate was calibrated on is all that is asked.
    Exit status 1 if they do not."""
    report: Path | None = None
    """Folder for a table, figures and a picture of how well λ warns."""
    run: Path | None = None
    """With --report: a training run's folder; its cost critic is measured as well."""


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
        silences: score of each episode, see `evaluation.exchange`.
    """

    gate: Gate
    missed: int
    violated: int
    open: float
    returns: float
    silences: tuple[float, ...] = ()


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
    check_target(config.bundle)
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
        # Those of the gate's own trial would not do: it was taken because they went well.
        count = min(config.episodes, MOST_SCORES)
        job = bar.add_task("to compare with", total=count)
        fresh = run(chosen, len(gates) + 1, _advance(bar, job), count)
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
        scores=tuple(sorted(fresh.silences)) or None,
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
        f"{100 * c.miss_rate:.4g}% are, confidence {100 * c.confidence:.4g}%; fixed sequence of {c.tried} "
        "gates"
    )


def _gates(config: CalibrateConfig) -> list[Gate]:
    rising = config.thresholds
    if not rising or any(a >= b for a, b in pairwise(rising)):
        raise CalibrateError(f"--thresholds must rise, from the most open gate on, got {list(rising)}")
    check_gate(config)
    return [Gate("risk", threshold, config.hysteresis, config.dwell) for threshold in rising]


def _allowed(config: CalibrateConfig) -> int:
    check_promise(config)
    if config.episodes < 1 or config.processes < 0 or config.seed < 0:
        raise CalibrateError("--episodes must be at least 1, --processes and --seed at least 0")
    allowed = most_missed(config.episodes, config.miss_rate, config.confidence)
    if allowed < 0:
        raise CalibrateError(
            f"--episodes {config.episodes} can show no miss rate of {config.miss_rate:g} with confidence "
            f"{config.confidence:g}, whatever the gate: "
            f"{least_episodes(config.miss_rate, config.confidence)} are needed"
        )
    return allowed


class Run(Protocol):
    """Runs a gate's episodes."""

    def __call__(self, gate: Gate, number: int, done: Callable[[int], None], count: int = ..., /) -> Tried:
        """The number-th lot of episodes, so many of it; `done` is told how many are."""


def _advance(bar: Progress, job: object) -> Callable[[int], None]:
    return lambda episodes: bar.advance(job, episodes)  # type: ignore[arg-type]


@contextmanager
def _workers(config: CalibrateConfig) -> Iterator[Run]:
    """Runs a gate's episodes, those of the number-th `episodes` of the seed, in several processes."""
    processes = config.processes or os.cpu_count() or 1
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:

        def run(gate: Gate, number: int, done: Callable[[int], None], count: int = config.episodes) -> Tried:
            starts = range(0, count, SIDE_BY_SIDE)
            parts = [
                pool.submit(
                    _episodes,
                    config,
                    gate,
                    number * config.episodes + start,
                    min(SIDE_BY_SIDE, count - start),
                )
                for start in starts
            ]
            found = []
            for part in as_completed(parts):
                found.append(part.result())
                done(len(found[-1].missed))
            whole = _Part(*(np.concatenate(column) for column in zip(*found, strict=True)))
            return Tried(
                gate,
                int(whole.missed.sum()),
                int(whole.violated.sum()),
                float(whole.open_steps.mean()) / EPISODE_STEPS,
                float(whole.returns.mean()),
                tuple(whole.silences.tolist()),
            )

        yield run


@lru_cache(maxsize=1)
def _monitor(bundle: Path, gate: Gate, guide: Strength) -> Monitor:
    """One a process: a gate's parts come one after the other."""
    return Monitor.load(bundle, gate, guide=guide)


class _Part(NamedTuple):
    """What E episodes came to, each by itself [E]."""

    missed: NDArray[np.bool_]
    violated: NDArray[np.bool_]
    open_steps: NDArray[np.int64]
    returns: FloatArray
    silences: FloatArray


class _Listening:
    """A monitor in the loop of robots side by side; it notes how silent λ was in their episodes."""

    def __init__(self, monitor: Monitor, robots: int) -> None:
        self.silences = np.zeros(robots)
        self.decide = monitor.decide
        self._monitor = monitor
        self._filter = barrier_filter(monitor)

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        decisions = self._monitor.decide_batch(observation, hazards, memory)
        # By the lidar, whatever the filter is given: a robot's log has no more.
        now = silence(decisions.risk[None], self._filter.look(observation).low[None])
        self.silences = np.fmax(self.silences, now)  # where the network gave no number, the gate is open
        return decisions


def _episodes(config: CalibrateConfig, gate: Gate, first: int, count: int) -> _Part:
    """Drives some episodes, all side by side."""
    monitor = _monitor(config.bundle, gate, config.guide)
    listening = _Listening(monitor, count)
    task = monitor.bundle.manifest.task
    done = run_episodes(task, listening, count, config.seed, config.hazards, use=Use.GATE, first=first)
    return _Part(
        done.opened_by[OpenedBy.BARRIER] > 0,
        done.violating_steps > 0,
        done.open_steps,
        done.returns,
        listening.silences,
    )


def main() -> None:
    """Entry point of `lagnet-calibrate`.

    Exit status 0; 2 if nothing could be promised or told as asked; 1 if a check finds that the calibration no
    longer applies.
    """
    expected = CalibrateError, TaskError, BundleError, MonitorError, NetworkError
    with command("lagnet-calibrate", *expected):
        config = settings(CalibrateConfig, "lagnet-calibrate")
        check_flags(config)
        console = terminal()
        if config.report is not None:
            _report(config, config.report, console)
        elif config.check:
            _check(config, console)
        elif config.novelty:
            _find_normal(config, console)
        else:
            _choose(config, console)


def check_flags(config: CalibrateConfig) -> None:
    """Refuses settings that contradict each other, or that would be ignored.

    Raises:
        CalibrateError: names the flag.
    """
    if config.check and not config.log:
        raise CalibrateError("--check needs the logs of the episodes in question: --log FILE")
    if config.run is not None and config.report is None:
        raise CalibrateError("--run adds a cost critic to what --report measures: it needs --report")
    if config.report is not None and config.log:
        raise CalibrateError("--report measures on episodes in simulation: it takes no --log")
    if not config.log:
        return
    used = {"bundle", "log", "check", "confidence"} | (
        set() if config.check else {"miss_rate", "hysteresis", "dwell"}
    )
    for field in fields(config):
        if field.name not in used and getattr(config, field.name) != field.default:
            mode = "--check" if config.check else "--log"
            raise CalibrateError(f"--{field.name.replace('_', '-')} has no meaning with {mode}")


def _report(config: CalibrateConfig, folder: Path, console: Console) -> None:
    from evaluation.warning import report

    if why := why_not_folder(folder):
        raise CalibrateError(f"--report {folder}: {why}")
    table_console().print(report(config, console))


def _find_normal(config: CalibrateConfig, console: Console) -> None:
    from evaluation.novelty import find_normal

    source = find_normal(config, console).novelty
    assert source is not None
    console.print(
        f"{config.bundle}: what is normal is learnt from {source.episodes} episodes; no alarm in "
        f"{source.limit_episodes} others, {source.hours:.1f} h: at most {source.alarms_per_hour:.2g} false "
        "alarms an hour, confidence 95%"
    )


def _check(config: CalibrateConfig, console: Console) -> None:
    found = check_logs(config)
    test, alarmed = found.test, found.alarmed
    console.print(
        f"{len(found.scored)} of {found.episodes} episodes have a score; martingale {test.value:.3g}, at its "
        f"highest {test.largest:.3g}, alarm from {test.bound:.3g} on"
    )
    if alarmed is None:
        console.print(f"{config.bundle}: nothing speaks against its calibration")
        return
    path, name = alarmed
    console.print(
        f"{config.bundle}: its calibration no longer applies: alarm in episode {name} of {path}, number "
        f"{test.alarmed} of those with a score; calibrate it anew"
    )
    sys.exit(NOT_AS_ASKED)


def _choose(config: CalibrateConfig, console: Console) -> None:
    if config.log:
        manifest = calibrate_on_logs(config)
    else:
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
