"""Checkpoints: one safetensors file, replaced atomically, no pickle.

Arrays are tensors of the file; everything else is JSON in its header. One file, so that no moment exists at
which two files disagree: a reader finds the old checkpoint or the new one.
"""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from trainer.errors import CheckpointError

FILE = "checkpoint.safetensors"
VERSION = 1
KEY = "lagnet"

Arrays = dict[str, npt.NDArray[Any]]


def write(folder: Path, arrays: Arrays, facts: dict[str, Any]) -> None:
    """Replaces the folder's checkpoint.

    Args:
        folder: of the run.
        arrays: by name.
        facts: anything JSON can hold.

    Raises:
        CheckpointError: if it cannot be written; the previous checkpoint is then untouched.
    """
    tensors = {name: np.array(value, order="C") for name, value in arrays.items()}
    header = {KEY: json.dumps({"version": VERSION, **facts})}
    replace(folder / FILE, save(tensors, metadata=header))


def replace(path: Path, content: bytes) -> None:
    """Writes a file so that after any interruption it holds its old content or the new, never a part.

    Raises:
        CheckpointError: if it cannot be written (full disk, no permission).
    """
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise CheckpointError(f"cannot write {path}: {error.strerror}") from error


def _sync_folder(folder: Path) -> None:
    """Makes a rename in the folder survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read(folder: Path) -> tuple[Arrays, dict[str, Any]]:
    """Reads the folder's checkpoint.

    Args:
        folder: of the run.

    Returns:
        Arrays by name, and the facts.

    Raises:
        CheckpointError: if there is none, or it is damaged or of another format.
    """
    path = folder / FILE
    if not path.is_file():
        raise CheckpointError(f"{folder} holds no checkpoint ({FILE})")
    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {})[KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(f"{path} is damaged or no checkpoint of a run: {error}") from error
    if facts.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has format version {facts.get('version')}, this program reads {VERSION}"
        )
    return arrays, facts
