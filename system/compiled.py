"""Compilation of the scalar loops with numba: one decision costs microseconds, and N cost N times that."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a helper that only compiled functions call; it becomes part of their machine code."""
    return cast(Function, numba.njit(error_model="numpy")(function))


def entry(function: Function) -> Function:
    """Compile a function that Python calls, and keep the machine code on disk between processes.

    numba compares the kept code with the entry's own file alone, not with the files of the helpers in it. An
    entry therefore has to hold `SOURCES` as a closure variable, which numba does compare.
    """
    return cast(Function, numba.njit(error_model="numpy", nogil=True, cache=True)(function))


_ROOMS = ("decision", "system", "filter", "guide")
"""The rooms that hold compiled code, and what goes into it."""


def _digest() -> str:
    """Hash of these rooms' sources."""
    digest = hashlib.sha256()
    for room in _ROOMS:
        for path in sorted((Path(__file__).parents[1] / room).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCES = _digest()
"""Changes with every change to compiled code."""
