"""Where each run of a sweep stands: what the driver moves, the table shows and the summary lists."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from trainer import checkpoint
from trainer.curves import Columns, closing, read_progress
from trainer.errors import CheckpointError
from trainer.report import TAIL
from trainer.sweep.settings import SweptRun
from trainer.sweep.worker import read_holder

SUMMARY = "summary.csv"
_HEADER = (
    "run", "algorithm", "cost_limit", "seed", "state", "steps", "episodes", "return", "cost", "multiplier"
)  # fmt: skip


class State(StrEnum):
    """Of a run."""

    WAITING = "waiting"
    RUNNING = "running"
    STOPPED = "stopped"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True)
class Progress:
    """What a run has reported last.

    Attributes:
        steps: environment steps done.
        mean_return: of the last 100 episodes, None before the first one has ended.
        cost: of the same episodes.
        multiplier: λ, for a network its mean over the epoch's states.
    """

    steps: int = 0
    mean_return: float | None = None
    cost: float | None = None
    multiplier: float | None = None


@dataclass
class Job:
    """One run and what has become of it.

    Attributes:
        run: what is trained.
        state: where it stands.
        error: what stopped it, if it failed.
        node: where it runs, or ran last.
        attempt: workers that this call has given to it.
        lost: workers lost in a row without any progress.
        started_at: steps done when the latest worker got it.
        progress: what it has reported last.
    """

    run: SweptRun
    state: State = State.WAITING
    error: str | None = None
    node: str = ""
    attempt: int = 0
    lost: int = 0
    started_at: int = 0
    progress: Progress = Progress()

    @property
    def active(self) -> bool:
        """Whether a worker has it, or will."""
        return self.state in {State.WAITING, State.RUNNING}

    def look(self) -> None:
        """Reads in the run's folder how far it is, and where."""
        self.progress = _latest(self.run.folder)
        holder = read_holder(self.run.claim)
        if self.active and holder.get("attempt") == self.attempt:
            self.state = State.RUNNING
            self.node = str(holder["node"])


def _latest(folder: Path) -> Progress:
    columns = _columns(folder)
    if not columns or not len(columns["steps"]):
        return Progress()
    last = {name: float(values[-1]) for name, values in columns.items()}
    shown = (last[name] for name in ("return_100", "cost_100", "multiplier"))
    return Progress(int(last["steps"]), *(None if np.isnan(value) else value for value in shown))


def _columns(folder: Path) -> Columns:
    try:
        return read_progress(folder)
    except CheckpointError:  # not begun
        return {}


def write_summary(folder: Path, jobs: Sequence[Job]) -> None:
    """Writes summary.csv: one row a run, its figures over the last 500 training episodes.

    Raises:
        CheckpointError: if it cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        (
            "run",
            "algorithm",
            "cost_limit",
            "seed",
            "state",
            "steps",
            "episodes",
            "return",
            "cost",
            "multiplier",
        )
    )
    for job in jobs:
        config, progress = job.run.config, job.progress
        columns = _columns(job.run.folder)
        figures = closing(columns, TAIL) if columns else None
        means: tuple[Any, ...] = (0, "", "")
        if figures is not None:
            means = (figures.episodes, figures.mean_return, figures.cost)
        multiplier = "" if progress.multiplier is None else progress.multiplier
        table.writerow(
            (
                job.run.name, config.algorithm, config.cost_limit, config.seed, job.state, progress.steps,
                *means, multiplier,
            )
        )  # fmt: skip
    checkpoint.replace(folder / SUMMARY, text.getvalue().encode())
