"""Compilation of the scalar loops with numba: one decision costs microseconds, and N cost N times that."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numba.extending

Function = TypeVar("Function", bound=Callable[..., Any])

_ROOMS = ("decision", "system", "filter", "guide", "inference", "novelty", "monitor")
"""The rooms that hold compiled code, and what goes into it."""


def compiled(function: Function) -> Function:
    """Compile a helper that only compiled functions call; it becomes part of their machine code."""
    return cast(Function, numba.njit(error_model="numpy")(function))


def by_precision(single: Callable[..., Any], double: Callable[..., Any]) -> Callable[..., Any]:
    """A helper of one number ``x`` that is one function for float32, another for float64."""

    def choose(x: Any) -> Any:
        raise NotImplementedError("for compiled code alone")

    def chosen(x: Any) -> Callable[..., Any]:
        return single if x == numba.types.float32 else double

    numba.extending.overload(choose, jit_options={"error_model": "numpy"}, strict=False)(chosen)
    return choose


def entry(function: Function) -> Function:
    """Compile a function that Python calls, and keep the machine code on disk between processes.

    numba compares kept code with the entry's own file alone, not with the files of the helpers in it: so the
    folder that it is kept in is named after all of them. Without a folder to write to, nothing is kept.
    """
    if _FOLDER is None:
        return cast(Function, numba.njit(error_model="numpy", nogil=True)(function))
    settings: Any = numba.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(_FOLDER)
    try:
        return cast(Function, numba.njit(error_model="numpy", nogil=True, cache=True)(function))
    finally:
        settings.CACHE_DIR = before


def _digest() -> str:
    """Hash of these rooms' sources."""
    digest = hashlib.sha256()
    for room in _ROOMS:
        for path in sorted((Path(__file__).parents[1] / room).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _ours(folder: Path) -> bool:
    """Whether nobody else can write there: what they wrote would run here."""
    status = folder.stat()
    return not hasattr(os, "getuid") or (status.st_uid in (0, os.getuid()) and not status.st_mode & 0o002)


def _folder() -> Path | None:
    """Where machine code is kept: beside the source, else in the user's own part of the temporary folder."""
    for place in _places():
        folder = place / _digest()
        try:
            for made in (place, folder):
                made.mkdir(mode=0o700, exist_ok=True)
            if all(map(_ours, (place, folder))) and os.access(folder, os.W_OK):
                return folder
        except OSError:
            continue
    return None


def _places() -> Iterator[Path]:
    yield Path(__file__).parent / "__pycache__"
    if hasattr(os, "getuid"):
        with suppress(OSError):  # there may be no temporary folder that can be used
            yield Path(tempfile.gettempdir()) / f"lagnet-{os.getuid()}"


_FOLDER = _folder()
