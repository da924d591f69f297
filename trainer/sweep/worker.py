"""What happens on a node: one run, trained in the process that Ray started for it."""

import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import TextIO

from trainer.config import FILE as CONFIG
from trainer.config import Config
from trainer.errors import CheckpointError, ConfigError, TrainerError
from trainer.sweep.settings import FOLDER, SweptRun

TOKEN = "token"
"""File that tells a node whether it sees the sweep's folder or one of its own at the same path."""
PATIENCE = 60.0
"""How long a run waits for the worker that had it before to be gone [s]."""


@dataclass(frozen=True)
class Outcome:
    """How a worker left its run.

    Attributes:
        finished: whether all steps are done (False if it was stopped, or on an error).
        error: one line that says what went wrong, or None.
    """

    finished: bool
    error: str | None = None


def work(run: SweptRun, token: str, attempt: int, node: str) -> Outcome:
    """Trains a run, or continues it.

    Ray stops it as Ctrl-C stops lagnet-train: the epoch is completed and its checkpoint written.

    Args:
        run: what to train.
        token: what DIR/.sweep/token holds if this node shares the sweep's storage.
        attempt: counts the workers that this call of lagnet-sweep has given to the run, from 1.
        node: for the record: where this is.

    Returns:
        How it ended.
    """
    from trainer.train import train  # with torch, which the process that only hands out runs does without

    try:
        _check_storage(run.folder.parent, token)
        with claim(run.claim, {"node": node, "pid": os.getpid(), "attempt": attempt}, PATIENCE):
            return Outcome(train(_settings(run)).finished)
    except TrainerError as error:
        return Outcome(False, str(error))


def _settings(run: SweptRun) -> Config:
    if (run.folder / CONFIG).exists():
        return Config(resume=run.folder)
    return run.config


def _check_storage(folder: Path, token: str) -> None:
    path = folder / FOLDER / TOKEN
    try:
        same = path.read_text() == token
    except OSError:
        same = False
    if not same:
        raise ConfigError(
            f"{socket.gethostname()} does not see the sweep's files in {folder}: "
            "--out must be on storage that every node shares, at the same path"
        )


@contextmanager
def claim(path: Path, holder: dict[str, str | int], patience: float) -> Iterator[None]:
    """Holds a file locked, so that no two processes write the same run.

    The operating system lets go of the lock when its process dies, however it dies. A node that the cluster
    has given up may still be writing; whoever comes next waits for it.

    Args:
        path: of the file; made if it is not there.
        holder: what to write into it.
        patience: how long to wait for another holder [s].

    Raises:
        CheckpointError: if another holder keeps it, or the storage cannot lock files.
    """
    with _open(path) as file:
        deadline = monotonic() + patience
        while not _lock(path, file.fileno()):
            if monotonic() >= deadline:
                file.seek(0)
                raise CheckpointError(f"{path} is in use by another process: {file.read().strip()}")
            sleep(0.1)
        file.truncate(0)
        file.write(json.dumps(holder) + "\n")
        file.flush()
        yield


def _open(path: Path) -> TextIO:
    try:
        return path.open("a+")
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error.strerror}") from error


def _lock(path: Path, handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise CheckpointError(f"cannot lock {path}: {error.strerror}") from error
    return True


def read_holder(path: Path) -> dict[str, str | int]:
    """What the latest holder wrote; empty if there is none, or it is being written."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
