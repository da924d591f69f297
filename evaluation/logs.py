"""A robot's log: what it observed and what happened, in a file that needs none of our code to be written.

An .npz of numpy with one row for each control step, episode after episode:

    observation   (T, O)   before the step, in the bundle's layout
    cost          (T,)     of the step: above 0, or true, in a violation
    episode       (T,)     a whole number, the same for all rows of an episode, which stand together

    np.savez("monday.npz", observation=observation, cost=cost, episode=episode)

Other arrays may lie beside them.
"""

from __future__ import annotations

import hashlib
import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import CalibrateError

FloatArray = NDArray[np.float64]
_UNREADABLE = (
    *(OSError, ValueError, EOFError, KeyError, OverflowError, MemoryError, NotImplementedError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, SyntaxError),
)
"""What numpy and zipfile raise on damaged files."""


@dataclass(frozen=True)
class Log:
    """A log that is in order.

    Attributes:
        path: its file.
        sha256: of the file.
        observation: (T, O).
        cost: (T,); None where it was not asked for.
        episodes: the rows of each episode.
        names: the number of each episode in the log.
    """

    path: Path
    sha256: str
    observation: FloatArray
    cost: FloatArray | None
    episodes: list[slice]
    names: list[int]


def read_log(path: Path, observation_size: int, costs: bool = True) -> Log:
    """Reads and checks a log.

    Args:
        path: of the file.
        observation_size: O, how many numbers the bundle's networks observe.
        costs: whether its costs are asked for; else it may have none.

    Raises:
        CalibrateError: names file and array, what was found and what was expected.
    """
    try:
        data = path.read_bytes()
        file = np.load(io.BytesIO(data), allow_pickle=False)
        if not isinstance(file, Mapping):
            raise ValueError("a single array")
        names = ("observation", "cost", "episode") if costs else ("observation", "episode")
        arrays = {name: _numbers(path, name, file) for name in names}
    except CalibrateError:
        raise
    except _UNREADABLE as error:
        why = getattr(error, "strerror", None) or "expected an .npz of numpy"
        raise CalibrateError(f"--log {path}: cannot be read: {why}") from error
    _check_shapes(path, arrays, observation_size)
    cost = arrays.get("cost")
    if cost is not None and (cost < 0).any():
        row = int(np.argmax(cost < 0))
        raise CalibrateError(f"--log {path}: cost must be at least 0, got {cost[row]:g} in row {row}")
    episodes, ids = _episodes(path, arrays["episode"])
    return Log(path, hashlib.sha256(data).hexdigest(), arrays["observation"], cost, episodes, ids)


def _numbers(path: Path, name: str, file: Mapping[str, NDArray[Any]]) -> FloatArray:
    """One array, whose values float32 can hold, as the networks take them."""
    if name not in file:
        there = ", ".join(sorted(file)) or "none"
        raise CalibrateError(
            f"--log {path}: no array {name}: expected observation, cost and episode; has {there}"
        )
    try:
        array = np.asarray(file[name])
    except ValueError as error:
        raise CalibrateError(f"--log {path}: {name} must be an array of numbers: {error}") from error
    if array.dtype.kind not in "biuf":
        raise CalibrateError(f"--log {path}: {name} must be numbers, got dtype {array.dtype}")
    numbers = array.astype(np.float64)
    bad = ~(np.abs(numbers) <= np.finfo(np.float32).max)
    if bad.any():
        where = ", ".join(str(place) for place in np.argwhere(bad)[0])
        first = numbers[bad][0]
        raise CalibrateError(
            f"--log {path}: {name}[{where}] must be a finite number of float32, got {first:g}"
        )
    return numbers


def _check_shapes(path: Path, arrays: Mapping[str, FloatArray], observation_size: int) -> None:
    observation = arrays["observation"]
    if observation.ndim != 2 or observation.shape[1] != observation_size or not len(observation):
        raise CalibrateError(
            f"--log {path}: observation must have shape (T, {observation_size}), T at least 1, "
            f"got {observation.shape}"
        )
    for name in arrays.keys() - {"observation"}:
        if arrays[name].shape != (len(observation),):
            raise CalibrateError(
                f"--log {path}: {name} must have shape ({len(observation)},), one number for each row of "
                f"observation, got {arrays[name].shape}"
            )


def _episodes(path: Path, episode: FloatArray) -> tuple[list[slice], list[int]]:
    """Each episode's rows, and its number."""
    if (episode != np.floor(episode)).any():
        row = int(np.argmax(episode != np.floor(episode)))
        raise CalibrateError(
            f"--log {path}: episode must be whole numbers, got {episode[row]:g} in row {row}"
        )
    starts = np.flatnonzero(np.r_[True, np.diff(episode) != 0.0])
    ends = np.r_[starts[1:], len(episode)]
    names = [int(episode[start]) for start in starts]
    seen: set[int] = set()
    for name, start in zip(names, starts, strict=True):
        if name in seen:
            raise CalibrateError(
                f"--log {path}: episode {name} begins again in row {start}: an episode's rows must stand "
                "together, and no two episodes have one number"
            )
        seen.add(name)
    return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)], names
