"""What the networks see, in compiled code: the numbers that `trainer.features` computes in torch.

In a graph they are forty operators, each dispatched by itself, and cost three times what the networks after
them cost. Operations and precision are the graph's, so what is rounded there is rounded here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from inference.errors import NetworkError
from models.features import FeatureNumbers
from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, layout
from system.compiled import compiled, entry

FloatArray = NDArray[np.float64]
Records = NDArray[np.void]
Row = Any
"""A row of an array of floats or of records, in compiled code."""

_LAYOUT = layout(1)
OBSERVATION = _LAYOUT.size
"""Numbers of an observation of a task with hazards."""
SIZE = OBSERVATION + 4 * LIDAR_BINS + 5
"""Numbers that the networks see of one."""
_VELOCITY = _LAYOUT.slice("velocimeter").start
_GOAL, _HAZARDS = _LAYOUT.slice("goal_lidar").start, _LAYOUT.slice("hazards_lidar").start


def _constants(real: DTypeLike) -> np.dtype[np.void]:
    """The constants of the formulas, in some precision, as compiled code takes them."""
    scalars = ("limit", "gain", "coasting", "sharpness", "fall", "half_fall")
    fixed = ("half_bin", "range", "tiny", "large", "none", "whole")
    sizes = {"center": OBSERVATION, "inverse": OBSERVATION, "quarters": 2}
    sizes |= dict.fromkeys(("middle", "ahead", "left"), LIDAR_BINS)
    return np.dtype(
        [*((name, real) for name in (*scalars, *fixed)), *((name, real, n) for name, n in sizes.items())],
        align=True,
    )


class Features:
    """Features of observations.

    Args:
        numbers: those in the formulas, for an observation of 60 numbers.
        real: float32 or float64, whichever the graph computes them in.
    """

    def __init__(self, numbers: FeatureNumbers, real: DTypeLike) -> None:
        angles = np.arange(LIDAR_BINS) * BIN_WIDTH
        values: dict[str, ArrayLike] = {
            "center": numbers.center,
            "inverse": numbers.inverse,
            "limit": numbers.limit,
            "gain": numbers.gain,
            "coasting": numbers.coasting,
            "sharpness": numbers.sharpness,
            "fall": -1.0 / numbers.length,
            "half_fall": -0.5 / numbers.length,
            "half_bin": 0.5 * BIN_WIDTH,
            "range": LIDAR_RANGE,
            "tiny": 1e-6,
            "large": 1e30,
            "none": 0.0,
            "whole": 1.0,
            "quarters": (np.pi / 2, 0.0),
            "middle": angles + 0.5 * BIN_WIDTH,
            "ahead": numbers.sharpness * np.cos(angles),
            "left": numbers.sharpness * np.sin(angles),
        }
        self._real = real
        self._constants = np.zeros(1, _constants(real))
        for name, value in values.items():
            # Constants are rounded to single precision in graphs of double precision, too.
            self._constants[name] = np.asarray(value, np.float32)

    def __call__(self, observation: FloatArray, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Features [N, SIZE] of observations [N, 60], in ``out`` if given; a row is what it is alone.

        Raises:
            NetworkError: if the observations are no such array.
        """
        if observation.ndim != 2 or observation.shape[1] != OBSERVATION:
            raise NetworkError(f"observations must be [N, {OBSERVATION}], got {list(observation.shape)}")
        features = np.empty((len(observation), SIZE), self._real) if out is None else out
        compute(self._constants, np.ascontiguousarray(observation, np.float64), features)
        return features


@entry
def compute(constants: Records, observation: FloatArray, features: NDArray[Any]) -> None:
    """Write the features [N, SIZE] of observations [N, 60]; ``constants`` (1,) are those of `Features`."""
    number, real = constants[0], features.dtype.type
    center, inverse = number.center, number.inverse
    seen, room = np.empty(OBSERVATION, features.dtype), np.empty((4, LIDAR_BINS), features.dtype)
    for k in range(len(observation)):
        for i in range(OBSERVATION):
            # A graph takes single precision, whatever it computes in.
            seen[i] = real(np.float32(observation[k, i]))
            features[k, i] = _clip((seen[i] - center[i]) * inverse[i], -number.limit, number.limit)
        _surroundings(number, seen, room, features[k, OBSERVATION:])


@compiled
def _surroundings(number: Row, seen: Row, room: Row, out: Row) -> None:
    """Numbers 1 to 5 of `trainer.features.Surroundings`, which has the formulas in words.

    ``room`` (4, LIDAR_BINS) is for what there is of each bin on the way.
    """
    real = seen.dtype.type
    zero, one, two = real(0), real(1), real(2)
    cos, sin, distance, exponent = room[0], room[1], room[2], room[3]
    goal, hazards = seen[_GOAL : _GOAL + LIDAR_BINS], seen[_HAZARDS : _HAZARDS + LIDAR_BINS]
    nearest = _largest(goal)
    heading, reading = _bearing(number, goal, nearest), goal[nearest]
    sight, behind = min(reading * number.large, one), (reading - one) * number.range

    # From here on in the goal's frame: ahead is where the goal is. First, the ends of both segments.
    vx, vy = seen[_VELOCITY] * number.coasting, seen[_VELOCITY + 1] * number.coasting
    towards, left = math.sin(heading + number.quarters[0]), math.sin(heading + number.quarters[1])
    x, y, goal_x = towards * vx + left * vy, towards * vy - left * vx, -behind * sight
    for b in range(LIDAR_BINS):
        exponent[b] = _bearing(number, hazards, b) - heading
        distance[b] = (one - hazards[b]) * number.range
    for b in range(LIDAR_BINS):
        cos[b], sin[b] = math.cos(exponent[b]), math.sin(exponent[b])
        out[b] = number.gain * math.exp(distance[b] * number.fall)
    for b in range(LIDAR_BINS):
        exponent[b] = number.fall * _apart(number, cos[b] * distance[b], sin[b] * distance[b], x, y)
    for b in range(LIDAR_BINS):
        out[LIDAR_BINS + b] = number.gain * math.exp(exponent[b])
    for b in range(LIDAR_BINS):
        exponent[b] = number.fall * _apart(number, cos[b] * distance[b], sin[b] * distance[b], goal_x, zero)
    for b in range(LIDAR_BINS):
        out[2 * LIDAR_BINS + b] = min(hazards[b] * number.large, number.gain) * math.exp(exponent[b])
    _map(number, cos, sin, distance, sight, exponent)
    for b in range(LIDAR_BINS):
        out[3 * LIDAR_BINS + b] = number.gain * math.exp(exponent[b])
    near = number.gain * math.exp(behind)
    # The graph's last matrix product: a number in it that is infinite makes NaN of all that it gives.
    spoilt = zero * x + zero * y + zero * near
    for i, part in enumerate((two * towards, two * left, near, number.gain * x, number.gain * y)):
        out[4 * LIDAR_BINS + i] = (part + spoilt) * sight


@compiled
def _largest(lidar: Row) -> int:
    """The bin of the largest reading, the first of several."""
    largest = 0
    for b in range(1, LIDAR_BINS):
        if lidar[b] > lidar[largest]:
            largest = b
    return largest


@compiled
def _bearing(number: Row, lidar: Row, b: int) -> float:
    """Of the object in a bin [rad]: the middle of what the neighbours' readings leave possible."""
    most = max(lidar[b], number.tiny)
    upper, lower = min(lidar[(b + 1) % LIDAR_BINS], most), min(lidar[(b - 1) % LIDAR_BINS], most)
    bearing: float = (upper - lower) / most * number.half_bin + number.middle[b]
    return bearing


@compiled
def _apart(number: Row, x: float, y: float, end_x: float, end_y: float) -> float:
    """Distance [m] of a place from the segment between the robot and an end."""
    share = (x * end_x + y * end_y) / (end_x * end_x + end_y * end_y + number.tiny)
    share = _clip(share, number.none, number.whole)
    x, y = x - share * end_x, y - share * end_y
    return math.sqrt(x * x + y * y)


@compiled
def _map(number: Row, cos: Row, sin: Row, distance: Row, sight: float, exponent: Row) -> None:
    """Write log(number 4 / gain) of every direction: the largest of all hazards'.

    ``cos``, ``sin`` and ``distance`` are used up. The hazards' loop is the inner one, so that their largest
    stays in a register: six times as fast.
    """
    for b in range(LIDAR_BINS):
        cos[b], sin[b] = cos[b] * sight, sin[b] * sight
        distance[b] = distance[b] * number.half_fall - number.sharpness
    for direction in range(LIDAR_BINS):
        ahead, left = number.ahead[direction], number.left[direction]
        shown = cos[0] * ahead + sin[0] * left + distance[0]
        for b in range(1, LIDAR_BINS):
            shown = max(shown, cos[b] * ahead + sin[b] * left + distance[b])
        exponent[direction] = shown


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
