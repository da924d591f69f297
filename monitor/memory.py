"""The filter's per-robot memory: one robot's share of a batch, and its way over JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter import FilterMemory


def take(memory: FilterMemory, index: int) -> FilterMemory:
    """One robot's share of a batch's memory, as the memory of a batch of one."""
    return FilterMemory(
        **{field.name: getattr(memory, field.name)[index : index + 1] for field in fields(memory)}
    )


def join(memories: Sequence[FilterMemory | None]) -> FilterMemory | None:
    """The memory of a batch from its robots' shares; None if any has none, for the filter works without."""
    known = [memory for memory in memories if memory is not None]
    if len(known) < len(memories):
        return None
    names = [field.name for field in fields(FilterMemory)]
    return FilterMemory(
        **{name: np.concatenate([getattr(memory, name) for memory in known]) for name in names}
    )


def memory_to_json(memory: FilterMemory | None) -> dict[str, list[float | int]] | None:
    """One robot's memory as plain JSON, to be handed back with the next observation."""
    if memory is None:
        return None
    return {field.name: getattr(memory, field.name)[0:1].tolist() for field in fields(memory)}


def memory_from_json(value: Mapping[str, object] | None) -> FilterMemory | None:
    """The inverse of `memory_to_json`.

    Raises:
        ValueError: if the value is not a memory that this version wrote; the message names the field.
    """
    if value is None:
        return None
    empty = FilterMemory.empty(1)
    names = {field.name for field in fields(empty)}
    if set(value) != names:
        raise ValueError(f"memory has the fields {sorted(value)}, expected {sorted(names)}")
    return FilterMemory(**{name: _array(name, value[name], getattr(empty, name)) for name in names})


def _array(name: str, value: object, like: NDArray[Any]) -> NDArray[Any]:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"memory.{name} must hold numbers") from error
    if array.shape != like.shape or not np.isfinite(array).all():
        raise ValueError(f"memory.{name} must have shape {list(like.shape)} and finite numbers")
    if np.issubdtype(like.dtype, np.integer):
        limits = np.iinfo(like.dtype)
        if (array != np.rint(array)).any() or array.min() < limits.min or array.max() > limits.max:
            raise ValueError(f"memory.{name} must hold whole numbers in {limits.min}..{limits.max}")
    return array.astype(like.dtype)
