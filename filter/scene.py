"""What the filter is given, checked, and what it makes of it: robots in motion and what is near them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import Memory, memory_of
from filter.errors import FilterInputError
from filter.kernel import SEEN, see
from pointgoal.observation import ObservationLayout, layout
from system.lidar import CONES
from system.obstacles import COLUMNS, FAR

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

DOUBT = "the hazards' lidar shows what no hazards can"
"""What is said of a scan that contradicts itself."""


@dataclass(frozen=True)
class _Columns:
    """Where an observation of one size has what the filter reads.

    Attributes:
        read: for `kernel.see`: velocity ahead, yaw rate, start and end of the hazards' lidar, which is empty
            at level 0, and start of the goal's.
        hazards: the hazards' lidar.
    """

    read: tuple[int, int, int, int, int]
    hazards: slice

    @staticmethod
    def of(where: ObservationLayout) -> _Columns:
        hazards = where.slice("hazards_lidar") if "hazards_lidar" in where else slice(0, 0)
        motion = where.slice("velocimeter").start, where.slice("gyro").stop - 1
        return _Columns((*motion, hazards.start, hazards.stop, where.slice("goal_lidar").start), hazards)


_COLUMNS = {where.size: _Columns.of(where) for where in (layout(0), layout(1))}


@dataclass(eq=False, slots=True)
class Scene:
    """N robots and what is near them.

    Attributes:
        observation: (N, O).
        columns: where the filter's numbers stand in it, see `kernel.see`.
        given: (N, n, 2) hazards [m], in the frame of the observation as well.
        seen: (N,) of `kernel.SEEN`: motion, count of obstacles, best backup.
        obstacles: (N, M, COLUMNS), from where the next action takes effect; of each robot's, the first
            ``seen["count"]`` count.
        source: (N, M) each one's hazard, or, behind those, its lidar bin.
        doubted: (N,) whether a sensor is not to be trusted; their barrier is NaN.
    """

    observation: FloatArray
    columns: tuple[int, int, int, int, int]
    given: FloatArray
    seen: NDArray[np.void]
    obstacles: FloatArray
    source: NDArray[np.int64]
    doubted: BoolArray

    def __len__(self) -> int:
        return len(self.seen)

    def doubt(self, which: BoolArray) -> None:
        """Trust nothing of what some robots (N,) see, nor how fast they are: they cannot brake."""
        self.doubted = self.doubted | which
        self.seen["now"]["clearance"][which] = np.nan
        self.seen["sure"]["clearance"][which] = -FAR
        self.seen["vx"][which] = 0.0

    @property
    def readings(self) -> FloatArray:
        """(N, 16) the hazards' lidar, or (N, 0)."""
        return self.observation[:, self.columns[2] : self.columns[3]]

    @property
    def barrier(self) -> FloatArray:
        """(N,) clearance [m] beyond the margin that the best backup keeps; at most the lidar's range."""
        barrier: FloatArray = self.seen["now"]["clearance"]
        return barrier

    @property
    def low(self) -> BoolArray:
        """(N,) whether the barrier is so low that some action may lead below 0: below the floor."""
        low: BoolArray = self.seen["sure"]["clearance"] < 0.0
        return low


def look(
    settings: NDArray[np.void], observation: FloatArray, given: FloatArray | None, memory: Memory
) -> Scene:
    """Find obstacles and best backups.

    ``observation`` is (N, 60) or (N, 28), ``given`` (N, n, 2) hazards [m] or None, ``memory`` (N,); a value
    of the observation that is not finite raises FilterInputError.
    """
    n, width = observation.shape
    columns = _COLUMNS[width]
    if given is None:
        given = np.empty((n, 0, 2))
    size = given.shape[1] + (CONES if columns.hazards.stop else 0)
    seen = np.empty(n, SEEN)
    obstacles, source = np.empty((n, size, COLUMNS)), np.empty((n, size), dtype=np.int64)
    bad = see(settings, observation, columns.read, given, memory, seen, obstacles, source)
    if bad >= 0:
        raise FilterInputError(f"observation[{bad % width}]", f"must be finite, got {observation.flat[bad]}")
    doubted = np.isnan(seen["now"]["clearance"])
    return Scene(observation, columns.read, given, seen, obstacles, source, doubted)


def check_observation(observation: ArrayLike) -> FloatArray:
    """(N, 60) or (N, 28), or FilterInputError."""
    checked = _array("observation", observation)
    if checked.ndim != 2 or checked.shape[1] not in _COLUMNS:
        sizes = " or ".join(f"(N, {size})" for size in sorted(_COLUMNS, reverse=True))
        raise FilterInputError("observation", f"expected shape {sizes}, got {checked.shape}")
    return checked


def check_action(action: ArrayLike, n: int) -> FloatArray:
    """(N, 2), clipped to ±1, or FilterInputError, also for a value that is not finite."""
    checked = _array("nominal_action", action)
    if checked.shape != (n, 2):
        raise FilterInputError("nominal_action", f"expected shape ({n}, 2), got {checked.shape}")
    if not _all(np.isfinite(checked)):
        raise FilterInputError("nominal_action", "has values that are not finite")
    return np.minimum(np.maximum(checked, -1.0), 1.0)


def check_hazards(hazards: ArrayLike | None, n: int) -> FloatArray | None:
    """(N, n, 2) or None, or FilterInputError, also for an infinite value or half a NaN."""
    if hazards is None:
        return None
    given = _array("hazards", hazards)
    if given.ndim != 3 or given.shape[0] != n or given.shape[2] != 2:
        raise FilterInputError("hazards", f"expected shape ({n}, n, 2), got {given.shape}")
    finite = np.isfinite(given)
    if not _all(finite) and not (finite.all(axis=2) | np.isnan(given).all(axis=2)).all():
        raise FilterInputError("hazards", "has values that are not finite; an absent hazard is NaN in both")
    return given


def check_active(active: ArrayLike | None, n: int) -> BoolArray:
    """(N,), or FilterInputError; None: all True."""
    if active is None:
        return np.ones(n, dtype=np.bool_)
    gate = np.ascontiguousarray(active, dtype=np.bool_)
    if gate.shape != (n,):
        raise FilterInputError("active", f"expected shape ({n},), got {gate.shape}")
    return gate


def check_memory(memory: Memory | None, n: int) -> Memory:
    """(N,) of `MEMORY`, or FilterInputError; None: a first step's."""
    try:
        return memory_of(n, memory)
    except ValueError as error:
        raise FilterInputError("memory", str(error)) from error


def _all(values: BoolArray) -> bool:
    # `values.all()` takes five times as long for a few.
    return bool(np.count_nonzero(values) == values.size)


def _array(field: str, values: ArrayLike) -> FloatArray:
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FilterInputError(field, f"is not an array of numbers: {error}") from error
