"""The table of a sweep, redrawn while it goes on."""

from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from trainer.sweep.job import Job, State

_ORDER = (State.RUNNING, State.FAILED, State.STOPPED, State.WAITING, State.FINISHED)
_COLOURS = {
    State.RUNNING: "cyan",
    State.FAILED: "red",
    State.STOPPED: "yellow",
    State.WAITING: "dim",
    State.FINISHED: "green",
}
_FRAME = 7
"""Lines that the table's frame, its heading and its last line take."""


class Board:
    """Shows the jobs: one live table on a terminal; elsewhere a line a change, and the table at the end."""

    def __init__(self, jobs: Sequence[Job], console: Console) -> None:
        self._jobs = jobs
        self._console = console
        self._said: dict[str, tuple[State, str]] = {}
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is None:
            self._console.print(table(self._jobs, len(self._jobs)))
            return
        self._live.update(table(self._jobs, len(self._jobs)))
        self._live.stop()

    def show(self) -> None:
        """Brings it up to date."""
        if self._live is not None:
            self._live.update(table(self._jobs, self._console.height - _FRAME), refresh=True)
            return
        for job in self._jobs:
            now = (job.state, job.node)
            if now != self._said.get(job.run.name, (State.WAITING, "")):
                self._console.print(_line(job))
                self._said[job.run.name] = now


def _line(job: Job) -> str:
    where = f" on {job.node}" if job.state == State.RUNNING else ""
    return f"{job.run.name}: {job.state}{where} at {job.progress.steps:,} steps"


def table(jobs: Sequence[Job], rows: int) -> Table:
    """The jobs as a table of at most so many rows, those first that something is happening to."""
    counts = Counter(job.state for job in jobs)
    shown = Table(caption=" · ".join(f"{counts[state]} {state}" for state in _ORDER if counts[state]))
    shown.add_column("run", no_wrap=True)
    shown.add_column("node", no_wrap=True)
    for heading in ("steps", "return", "cost", "λ"):
        shown.add_column(heading, justify="right", no_wrap=True)
    shown.add_column("state", no_wrap=True)
    kept = list(jobs)
    if len(kept) > rows:
        kept = sorted(kept, key=lambda job: _ORDER.index(job.state))[: max(rows, 1)]
    for job in kept:
        progress = job.progress
        total = job.run.config.epochs * job.run.config.epoch_steps
        shown.add_row(
            job.run.name,
            job.node,
            f"{progress.steps:,} ({progress.steps / total:4.0%})",
            *(_number(value) for value in (progress.mean_return, progress.cost, progress.multiplier)),
            Text(job.state + (f" (worker {job.attempt})" if job.attempt > 1 else ""), _COLOURS[job.state]),
        )
    return shown


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
