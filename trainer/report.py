"""What a run says while it goes: progress.csv, TensorBoard events and the progress bar."""

import csv
import io
import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from trainer.errors import CheckpointError

FILE = "progress.csv"
TAIL = 500
"""Episodes that a run's closing figures are averaged over."""
Row = dict[str, float | int | None]


class ProgressFile:
    """progress.csv: one row an epoch.

    It holds no wall-clock figures, so that a resumed run's file repeats bit for bit.

    Attributes:
        length: bytes written so far; a checkpoint keeps it.
    """

    def __init__(self, folder: Path, length: int = 0) -> None:
        """Opens the file cut back to `length` bytes.

        Raises:
            CheckpointError: if it cannot be opened, or is shorter than that.
        """
        self.path = folder / FILE
        self.length = length
        self._columns: list[str] | None = None
        try:
            if length and self.path.stat().st_size < length:
                raise CheckpointError(f"{self.path} is shorter than when the checkpoint was written")
            self._file = self.path.open("r+b" if length else "wb")
            self._file.truncate(length)
            if length:
                self._columns = self._file.readline().decode().strip().split(",")
            self._file.seek(length)
        except OSError as error:
            raise CheckpointError(f"cannot write {self.path}: {error.strerror}") from error

    def add(self, row: Row) -> None:
        """Appends a row; the first one's keys are the header.

        Raises:
            CheckpointError: if the disk does not take it.
        """
        text = io.StringIO()
        if self._columns is None:
            self._columns = list(row)
            csv.writer(text, lineterminator="\n").writerow(self._columns)
        cells = ["" if row.get(name) is None else repr(row[name]) for name in self._columns]
        csv.writer(text, lineterminator="\n").writerow(cells)
        content = text.getvalue().encode()
        try:
            self._file.write(content)
            self._file.flush()
        except OSError as error:
            raise CheckpointError(f"cannot write {self.path}: {error.strerror}") from error
        self.length += len(content)

    def sync(self) -> None:
        """Forces the rows onto the disk: a checkpoint must not count bytes that a power cut can take."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise CheckpointError(f"cannot write {self.path}: {error.strerror}") from error

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


class Events:
    """TensorBoard events; does nothing when switched off."""

    def __init__(self, folder: Path, enabled: bool, purge_after: int) -> None:
        self._writer: Any = None
        if enabled:
            from torch.utils.tensorboard.writer import SummaryWriter

            self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=purge_after + 1)

    def add(self, row: Row, steps: int) -> None:
        """Writes each figure of a row at that many environment steps."""
        if self._writer is not None:
            for name, value in row.items():
                if value is not None:
                    self._writer.add_scalar(name, value, steps)

    def close(self) -> None:
        """Writes what is pending."""
        if self._writer is not None:
            self._writer.close()


_BAR, _TIME = 16, 9
"""Columns of a terminal that the bar takes, and the time that remains."""


class Bar:
    """Shows how a run gets on: a bar on a terminal, elsewhere one line an epoch.

    Both give return, cost, λ and steps a second, as many of them as there is room for.
    """

    def __init__(self, total_steps: int, done: int, console: Console) -> None:
        self._console = console
        self._total = total_steps
        self._bar = Progress(
            TimeRemainingColumn(compact=True),
            BarColumn(bar_width=_BAR),
            TextColumn("{task.fields[figures]}", markup=False),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("train", total=total_steps, completed=done, figures="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, steps: int, row: Row, rate: float) -> None:
        """Moves on by an epoch."""
        parts = [f"{steps:,}/{self._total:,} steps"]
        for label, name in (("return", "return_100"), ("cost", "cost_100"), ("λ", "multiplier")):
            value = row[name]
            parts.append(f"{label} {value:.2f}" if isinstance(value, float) else f"{label} –")
        parts.append(f"{rate:,.0f} steps/s")
        if not self._console.is_terminal:
            self._console.print(" · ".join(parts))
            return
        while len(parts) > 1 and len(" · ".join(parts)) > self._console.width - _BAR - _TIME:
            parts.pop()
        self._bar.update(self._task, completed=steps, figures=" · ".join(parts))
