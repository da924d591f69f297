"""What the filter is given, checked, and what it makes of it: robots in motion and what is near them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import MEMORY, Memory
from filter.errors import FilterInputError
from filter.kernel import SEEN, see
from pointgoal.observation import ObservationLayout, layout
from system.lidar import CONES
from system.obstacles import COLUMNS

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class _Columns:
    """Where an observation of one size has what the filter reads.

    Attributes:
        motion: velocity ahead, velocity to the left, yaw rate.
        goal: the goal's lidar.
        hazards: the hazards' lidar; empty at level 0, which has none.
    """

    motion: list[int]
    goal: slice
    hazards: slice

    @staticmethod
    def of(where: ObservationLayout) -> _Columns:
        velocity = where.slice("velocimeter").start
        hazards = where.slice("hazards_lidar") if "hazards_lidar" in where else slice(0, 0)
        return _Columns(
            [velocity, velocity + 1, where.slice("gyro").stop - 1], where.slice("goal_lidar"), hazards
        )


_COLUMNS = {where.size: _Columns.of(where) for where in (layout(0), layout(1))}


@dataclass(frozen=True)
class Scene:
    """N robots and what is near them.

    Attributes:
        seen: (N,) of `kernel.SEEN`: motion, count of obstacles, best backup.
        obstacles: (N, M, COLUMNS); of each robot's, the first ``seen["count"]`` count.
        source: (N, M) each one's hazard, or, behind those, its lidar bin.
        given: (N, n, 2) hazards [m].
        readings: (N, 16) the hazards' lidar, or (N, 0).
        goal: (N, 16) the goal's lidar.
    """

    seen: NDArray[np.void]
    obstacles: FloatArray
    source: NDArray[np.int64]
    given: FloatArray
    readings: FloatArray
    goal: FloatArray

    def __len__(self) -> int:
        return len(self.seen)

    @property
    def barrier(self) -> FloatArray:
        """(N,) clearance [m] beyond the margin that the best backup keeps; at most the lidar's range."""
        return np.asarray(self.seen["now"]["clearance"])

    @property
    def low(self) -> BoolArray:
        """(N,) whether the barrier is so low that some action may lead below 0: below the floor."""
        return np.asarray(self.seen["sure"]["clearance"] < 0.0)


def look(settings: NDArray[np.void], observation: FloatArray, given: FloatArray | None) -> Scene:
    """Find obstacles and best backups; the arguments are checked ones."""
    n, width = observation.shape
    columns = _COLUMNS[width]
    if given is None:
        given = np.empty((n, 0, 2))
    readings = np.ascontiguousarray(observation[:, columns.hazards])
    size = given.shape[1] + (CONES if readings.shape[1] else 0)
    seen = np.empty(n, SEEN)
    obstacles, source = np.empty((n, size, COLUMNS)), np.empty((n, size), dtype=np.int64)
    see(settings, observation[:, columns.motion], given, readings, seen, obstacles, source)
    return Scene(seen, obstacles, source, given, readings, observation[:, columns.goal])


def check_observation(observation: ArrayLike) -> FloatArray:
    """(N, 60) or (N, 28).

    Raises:
        FilterInputError: if it is not, or has a value that is not finite.
    """
    checked = _array("observation", observation)
    if checked.ndim != 2 or checked.shape[1] not in _COLUMNS:
        sizes = " or ".join(f"(N, {size})" for size in sorted(_COLUMNS, reverse=True))
        raise FilterInputError("observation", f"expected shape {sizes}, got {checked.shape}")
    if not np.isfinite(checked).all():
        raise FilterInputError("observation", "has values that are not finite")
    return checked


def check_action(action: ArrayLike, n: int) -> FloatArray:
    """(N, 2), clipped to ±1.

    Raises:
        FilterInputError: if it is not, or has a value that is no number.
    """
    checked = _array("nominal_action", action)
    if checked.shape != (n, 2):
        raise FilterInputError("nominal_action", f"expected shape ({n}, 2), got {checked.shape}")
    if not np.isfinite(checked).all():
        raise FilterInputError("nominal_action", "has values that are not finite")
    return np.minimum(np.maximum(checked, -1.0), 1.0)


def check_hazards(hazards: ArrayLike | None, n: int) -> FloatArray | None:
    """(N, n, 2) or None.

    Raises:
        FilterInputError: if it is not, or has an infinite value or half a NaN.
    """
    if hazards is None:
        return None
    given = _array("hazards", hazards)
    if given.ndim != 3 or given.shape[0] != n or given.shape[2] != 2:
        raise FilterInputError("hazards", f"expected shape ({n}, n, 2), got {given.shape}")
    finite = np.isfinite(given)
    if not finite.all() and not (finite.all(axis=2) | np.isnan(given).all(axis=2)).all():
        raise FilterInputError("hazards", "has values that are not finite; an absent hazard is NaN in both")
    return given


def check_active(active: ArrayLike | None, n: int) -> BoolArray:
    """(N,); None: all True.

    Raises:
        FilterInputError: if it is not.
    """
    if active is None:
        return np.ones(n, dtype=np.bool_)
    gate = np.ascontiguousarray(active, dtype=np.bool_)
    if gate.shape != (n,):
        raise FilterInputError("active", f"expected shape ({n},), got {gate.shape}")
    return gate


def check_memory(memory: Memory | None, n: int) -> Memory:
    """A copy (N,) of `MEMORY`; None: a first step's.

    Raises:
        FilterInputError: if it is not that of n robots.
    """
    if memory is None:
        return np.zeros(n, MEMORY)
    if not isinstance(memory, np.ndarray | np.void) or memory.dtype != MEMORY or memory.size != n:
        raise FilterInputError("memory", f"expected that of {n} robots")
    return memory.reshape(n).copy()


def _array(field: str, values: ArrayLike) -> FloatArray:
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FilterInputError(field, f"is not an array of numbers: {error}") from error
