"""Watches what robots see: learnt from a bundle's own drives, run before every decision."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from decision import Memory
from novelty import consistency
from novelty.consistency import (
    FOUND,
    GROUPS,
    count_of_numbers,
    groups_of_numbers,
    numbers_of,
    tables_for,
)
from system.point_robot import Robot

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FLOORS = np.array(
    [
        [0.5, 0.02, 0.5, 0.002, 0.002, 0.002, 0.002],
        [0.01, 0.0005, 0.01, 0.0005, 0.0002, 0.0002, 0.0002],
        [0.0] * 7,
    ]
)
"""Least limits: of what a sensor may be off, of what it should have changed by though it did not [m/s^2, m/s,
rad/s, 1, m], and none of its surprise."""
KINDS = len(FLOORS)
BEYOND = 1.5
"""A limit is this times the largest that was seen."""
_RIDGE = 1e-3
"""Added to the variances, in parts of their mean: no sensor is exact."""
_LEAST_VARIANCE = 1e-6
_NAMES = np.array(GROUPS, dtype="<U13")


@dataclass(frozen=True)
class Normal:
    """What is normal for a policy on its robot.

    Attributes:
        mean: (m,) of the numbers that `consistency.numbers_of` makes of an observation.
        precision: (m, m), the inverse of their covariance.
        least: (3,) the strongest reading that a scan of each lidar shows at least.
        limits: (3, 7) of each sensor's distances, kind by kind, see `consistency`.
    """

    mean: FloatArray
    precision: FloatArray
    least: FloatArray
    limits: FloatArray

    def to_bytes(self) -> bytes:
        """An NPZ file of the arrays."""
        file = io.BytesIO()
        np.savez_compressed(file, **{name: array.astype(np.float32) for name, array in vars(self).items()})
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes, observation_size: int) -> Normal:
        """The inverse of `to_bytes`, for observations of a size.

        Raises:
            ValueError: if it is not such a file, naming the array that is missing or wrong.
        """
        m = count_of_numbers(observation_size)
        shapes = {"mean": (m,), "precision": (m, m), "least": (3,), "limits": (KINDS, 7)}
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                found = {name: np.asarray(file[name]) for name in shapes}
        except Exception as error:
            raise ValueError(f"no NPZ file with {', '.join(shapes)}: {error}") from error
        for name, shape in shapes.items():
            array = found[name]
            if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
                raise ValueError(f"{name} must be {list(shape)} finite numbers")
            found[name] = array.astype(np.float64)
        if not (found["limits"] > 0.0).all():
            raise ValueError("limits must be above 0")
        return Normal(**found)


@dataclass(eq=False, slots=True)
class Findings:
    """What is to be said of N observations.

    Attributes:
        found: (N,) of `consistency.FOUND`.
        novelty: (N,) the largest distance in parts of its limit.
        suspect: (N,) the sensors' names where it is above 1, else "".
        any: whether one is doubted, or suspect.
    """

    found: NDArray[np.void]
    novelty: FloatArray
    suspect: NDArray[np.str_]
    any: bool

    @property
    def doubted(self) -> BoolArray:
        """(N,) whether a sensor that the filter steers by is not trusted."""
        doubted: BoolArray = self.found["doubted"]
        return doubted

    @property
    def off(self) -> FloatArray:
        """(N, 3, 7) the distances."""
        off: FloatArray = self.found["off"]
        return off


class Watch:
    """Looks at observations before anything is decided on them. It keeps nothing: robots' memory does.

    Args:
        normal: what is.
        robot: the robot's constants.
        delay_steps: control steps until an action takes effect, as the filter has them.

    Raises:
        ValueError: if the precision of what is normal is none.
    """

    def __init__(self, normal: Normal, robot: Robot, delay_steps: int = 0) -> None:
        self.normal = normal
        self._tables = _tables(normal, robot, delay_steps)

    def look(self, observation: FloatArray, memory: Memory) -> Findings:
        """What is to be said of N observations (N, O), which are finite, given the robots' memory (N,)."""
        n = len(observation)
        found = np.empty(n, FOUND)
        any_of_them = consistency.look(self._tables, observation, memory, found)
        novelty = found["novelty"]
        suspect = np.where(novelty > 1.0, _NAMES[found["suspect"]], "") if any_of_them else _nobody(n)
        return Findings(found, novelty, suspect, any_of_them)

    def remember(self, observation: FloatArray, findings: Findings, memory: Memory) -> None:
        """Write into N robots' memory what was seen, and what is not trusted."""
        consistency.remember(observation, findings.found, memory)


@lru_cache(maxsize=64)
def nothing(n: int) -> Findings:
    """What is to be said of N observations that nobody looks at."""
    return Findings(np.zeros(n, FOUND), np.full(n, np.nan), _nobody(n), False)


def learn(observation: FloatArray) -> Normal:
    """What is normal, from observations (n, O) of a policy's own drives; the limits are still to be found."""
    numbers = np.empty((len(observation), count_of_numbers(observation.shape[1])))
    numbers_of(np.ascontiguousarray(observation, np.float64), numbers)
    covariance = np.cov(numbers.T)
    ridge = _RIDGE * np.maximum(np.diag(covariance), np.diag(covariance).mean()) + _LEAST_VARIANCE
    precision = np.asarray(np.linalg.inv(covariance + np.diag(ridge)), np.float64)
    mean: FloatArray = numbers.mean(axis=0)
    return Normal(mean, precision, np.zeros(3), np.full((KINDS, 7), np.inf))


def calibrate(normal: Normal, largest: FloatArray, least: FloatArray) -> Normal:
    """With the limits that leave out what was seen.

    Args:
        normal: what was learnt.
        largest: (3, 7) the largest distances in drives that nothing was learnt from.
        least: (3,) the least of their scans' strongest readings, for each lidar.
    """
    limits = np.maximum(BEYOND * largest, FLOORS)
    return Normal(normal.mean, normal.precision, 0.5 * least, np.maximum(limits, 1e-6))


@lru_cache(maxsize=64)
def _nobody(n: int) -> NDArray[np.str_]:
    return np.full(n, "", dtype="<U13")


def _tables(normal: Normal, robot: Robot, delay_steps: int) -> NDArray[np.void]:
    """What `consistency.look` takes (1,)."""
    order, bounds = groups_of_numbers(len(normal.mean))
    apart = np.empty_like(normal.precision)
    for first, last in pairwise(bounds.tolist()):
        block = order[first:last]
        try:
            lower = np.linalg.cholesky(normal.precision[np.ix_(block, block)])
        except np.linalg.LinAlgError as error:
            raise ValueError("precision must be positive definite") from error
        apart[first:last] = np.linalg.solve(lower, normal.precision[block])
    tables = np.zeros(1, tables_for(len(normal.mean)))
    tables["robot"], tables["delay"], tables["bounds"] = tuple(robot), delay_steps, bounds
    tables["least"], tables["limits"] = normal.least, normal.limits
    # Column by column: compiled code adds one to another.
    tables["mean"], tables["apart"] = normal.mean, apart.T
    return tables
