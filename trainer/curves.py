"""A run's progress.csv read back: for pictures, for summaries and for the table of a sweep."""

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from trainer.config import FILE as CONFIG
from trainer.errors import CheckpointError
from trainer.report import FILE

Columns = dict[str, npt.NDArray[np.float64]]
_NAME = re.compile(r"(?P<algorithm>.+)-d(?P<limit>[0-9.e+-]+)-s(?P<seed>[0-9]+)")


@dataclass(frozen=True)
class Curves:
    """What one run has reported so far.

    Attributes:
        folder: of the run.
        algorithm: its name; the folder's, where nothing says more.
        cost_limit: d, None where nothing says it.
        seed: None where nothing says it.
        columns: by name [E], one value an epoch, NaN where the run had nothing to report.
    """

    folder: Path
    algorithm: str
    cost_limit: float | None
    seed: int | None
    columns: Columns


def read_curves(folder: Path) -> Curves:
    """Reads a run, which may still be going on.

    Algorithm, limit and seed come from the run's settings, or from a name such as ppo-lag-d0.5-s1 where
    those cannot be read.

    Raises:
        CheckpointError: if the folder holds no progress.csv that can be read.
    """
    columns = read_progress(folder)
    name = folder.resolve().name
    found = _NAME.fullmatch(name)
    try:
        # Read as it is: a run of another version, whose settings no longer fit, can still be looked at.
        said = json.loads((folder / CONFIG).read_text())
        return Curves(folder, said["algorithm"], float(said["cost_limit"]), int(said["seed"]), columns)
    except (OSError, ValueError, KeyError, TypeError):
        if found is None:
            return Curves(folder, name, None, None, columns)
        return Curves(folder, found["algorithm"], float(found["limit"]), int(found["seed"]), columns)


def read_progress(folder: Path) -> Columns:
    """The columns of a run's progress.csv, by name [E].

    A last line without its end is one that is being written, or was when the power went; it and anything
    after a row that cannot be read is left out: the run writes it again when it goes on.

    Raises:
        CheckpointError: if there is no such file, or it cannot be read.
    """
    path = folder / FILE
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder} holds no {FILE}") from error
    except OSError as error:
        raise CheckpointError(f"cannot read {path}: {error.strerror}") from error
    whole = content[: content.rfind(b"\n") + 1].decode(errors="replace")
    lines = csv.reader(whole.splitlines())
    header = next(lines, [])
    rows: list[list[float]] = []
    for cells in lines:
        try:
            row = [float(cell) if cell else np.nan for cell in cells]
        except ValueError:
            break
        if len(row) != len(header):
            break
        rows.append(row)
    table = np.asarray(rows, np.float64).reshape(len(rows), len(header))
    return {name: table[:, index] for index, name in enumerate(header)}


@dataclass(frozen=True)
class Closing:
    """Means over the last training episodes of a run.

    Attributes:
        episodes: how many they are.
        mean_return: undiscounted return.
        cost: undiscounted cost.
    """

    episodes: int
    mean_return: float
    cost: float


def closing(columns: Columns, episodes: int) -> Closing | None:
    """Means over the last `episodes` training episodes; None before one has ended.

    progress.csv has means over the episodes that ended in an epoch; the oldest epoch that is needed counts
    with as many of its episodes as are missing.
    """
    ended = columns["episodes_ended"][::-1]
    before = np.cumsum(ended) - ended
    weight = np.clip(episodes - before, 0, ended)
    used = weight > 0
    if not used.any():
        return None
    weight = weight[used]
    returns, costs = (np.average(columns[name][::-1][used], weights=weight) for name in ("return", "cost"))
    return Closing(int(weight.sum()), float(returns), float(costs))
