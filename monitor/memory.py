"""The filter's per-robot memory: one robot's share of a batch, and its way over JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter import FilterMemory

_NAMES = tuple(field.name for field in fields(FilterMemory))


def take(memory: FilterMemory, index: int) -> FilterMemory:
    """One robot's share of a batch's memory, as the memory of a batch of one."""
    return FilterMemory(**{name: getattr(memory, name)[index : index + 1] for name in _NAMES})


def fits(memory: object, count: int) -> bool:
    """Whether something is the memory of that many robots."""
    return isinstance(memory, FilterMemory) and all(len(getattr(memory, name)) == count for name in _NAMES)


def join(memories: Sequence[FilterMemory | None]) -> FilterMemory | None:
    """The memory of a batch from its robots' shares; None if any has none, for the filter works without."""
    known = [memory for memory in memories if memory is not None]
    if len(known) < len(memories):
        return None
    return FilterMemory(
        **{name: np.concatenate([getattr(memory, name) for memory in known]) for name in _NAMES}
    )


def memory_to_json(memory: FilterMemory | None) -> dict[str, list[float | int]] | None:
    """One robot's memory as plain JSON, to be handed back with the next observation."""
    if memory is None:
        return None
    return {name: getattr(memory, name)[0].ravel().tolist() for name in _NAMES}


def memory_from_json(value: Mapping[str, Sequence[float | int]] | None) -> FilterMemory | None:
    """The inverse of `memory_to_json`.

    Raises:
        ValueError: if the value is not a memory that this version wrote; the message names the field.
    """
    if value is None:
        return None
    empty = FilterMemory.empty(1)
    if set(value) != set(_NAMES):
        raise ValueError(f"memory has the fields {sorted(value)}, expected {sorted(_NAMES)}")
    return FilterMemory(**{name: _array(name, value[name], getattr(empty, name)) for name in _NAMES})


def _array(name: str, numbers: Sequence[float | int], like: NDArray[Any]) -> NDArray[Any]:
    if len(numbers) != like.size:
        raise ValueError(f"memory.{name} must hold {like.size} numbers, got {len(numbers)}")
    if np.issubdtype(like.dtype, np.integer):
        limits = np.iinfo(like.dtype)
        if not all(limits.min <= number <= limits.max and number == int(number) for number in numbers):
            raise ValueError(f"memory.{name} must hold whole numbers in {limits.min}..{limits.max}")
    elif not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"memory.{name} must hold finite numbers")
    return np.array(numbers).astype(like.dtype).reshape(like.shape)
