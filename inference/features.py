"""What the networks see, in compiled code: the numbers that `trainer.features` computes in torch.

In a graph they are forty operators, each dispatched by itself, and cost three times what the networks after
them cost. Operations and precision are the graph's, so what is rounded there is rounded here; only an
exponential, a sine or a cosine may be off by a unit in its last place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from inference.elementary import FAR, cos_sin, exp
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
    fixed = ("half_bin", "quarter", "range", "tiny", "large")
    sizes = {"center": OBSERVATION, "inverse": OBSERVATION}
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
            "quarter": 0.5 * np.pi,
            "range": LIDAR_RANGE,
            "tiny": 1e-6,
            "large": 1e30,
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
    """Write the features [N, SIZE] of observations [N, 60]; ``constants`` (1,) are those of `Features`.

    A loop over a robot's numbers becomes a few vector instructions if there are no branches or calls in it,
    and what it writes is known to be none of what it reads: so each result has an array of its own, and no
    loop reads a scalar of the constants. Nor may it be so short that the compiler unrolls it first: hence as
    much as goes into one.
    """
    number, real = constants[0], features.dtype.type
    center, inverse, limit = number.center, number.inverse, number.limit
    seen, ring = np.empty(OBSERVATION, features.dtype), np.empty(LIDAR_BINS + 2, features.dtype)
    angle, level = np.empty(LIDAR_BINS, features.dtype), np.empty(LIDAR_BINS, features.dtype)
    cos, sin = np.empty(LIDAR_BINS, features.dtype), np.empty(LIDAR_BINS, features.dtype)
    exponent, scale = np.empty(4 * LIDAR_BINS, features.dtype), np.full(4 * LIDAR_BINS, number.gain)
    for k in range(len(observation)):
        for i in range(OBSERVATION):
            # A graph takes single precision, whatever it computes in.
            seen[i] = real(np.float32(observation[k, i]))
        for i in range(OBSERVATION):
            features[k, i] = _clip((seen[i] - center[i]) * inverse[i], -limit, limit)
        last = _surroundings(number, seen, ring, angle, cos, sin, level, exponent, scale)
        for i in range(4 * LIDAR_BINS):
            features[k, OBSERVATION + i] = scale[i] * exp(exponent[i])
        for i in range(len(last)):
            features[k, OBSERVATION + 4 * LIDAR_BINS + i] = last[i]


@compiled
def _surroundings(
    number: Row,
    seen: Row,
    ring: Row,
    angle: Row,
    cos: Row,
    sin: Row,
    level: Row,
    exponent: Row,
    scale: Row,
) -> tuple[float, float, float, float, float]:
    """Numbers 1 to 5 of `trainer.features.Surroundings`, which has the formulas in words.

    Of 1 to 4 it writes the ``exponent`` and the ``scale``, 5 it returns; the rest is for what there is of
    each bin on the way.
    """
    real = seen.dtype.type
    zero, one, two, limit = real(0), real(1), real(2), real(FAR)
    gain, fall, half_fall, sharpness = number.gain, number.fall, number.half_fall, number.sharpness
    half_bin, reach, tiny, large = number.half_bin, number.range, number.tiny, number.large
    middle, quarter = number.middle, number.quarter
    nearest = _largest(seen)
    reading, after = seen[_GOAL + nearest], seen[_GOAL + (nearest + 1) % LIDAR_BINS]
    before = seen[_GOAL + (nearest - 1) % LIDAR_BINS]
    heading = _bearing(before, reading, after, half_bin, tiny) + middle[nearest]
    sight, behind = min(reading * large, one), (reading - one) * reach

    # From here on in the goal's frame: ahead is where the goal is. First, the ends of both segments.
    vx, vy = seen[_VELOCITY] * number.coasting, seen[_VELOCITY + 1] * number.coasting
    (_, towards), (_, left) = cos_sin(heading + quarter), cos_sin(heading)
    for b in range(LIDAR_BINS):
        ring[b + 1] = seen[_HAZARDS + b]
    ring[0], ring[LIDAR_BINS + 1] = ring[LIDAR_BINS], ring[1]
    far = 0 if abs(heading) < limit else 1
    for b in range(LIDAR_BINS):
        angle[b] = _bearing(ring[b], ring[b + 1], ring[b + 2], half_bin, tiny) + middle[b] - heading
        cos[b], sin[b] = cos_sin(angle[b])
        far += 0 if abs(angle[b]) < limit else 1
    if far > 0:  # where a reading is below 0
        towards, left = math.sin(heading + quarter), math.sin(heading)
        for b in range(LIDAR_BINS):
            cos[b], sin[b] = math.cos(angle[b]), math.sin(angle[b])
    x, y, goal_x = towards * vx + left * vy, towards * vy - left * vx, -behind * sight
    for b in range(LIDAR_BINS):
        distance = (one - ring[b + 1]) * reach
        bx, by = cos[b] * distance, sin[b] * distance
        exponent[b] = distance * fall
        exponent[LIDAR_BINS + b] = fall * _apart(bx, by, x, y, zero, one, tiny)
        exponent[2 * LIDAR_BINS + b] = fall * _apart(bx, by, goal_x, zero, zero, one, tiny)
        scale[2 * LIDAR_BINS + b] = min(ring[b + 1] * large, gain)
        level[b] = distance * half_fall - sharpness
        cos[b], sin[b] = cos[b] * sight, sin[b] * sight
    # Number 4 of every direction: the largest of all hazards'.
    for direction in range(LIDAR_BINS):
        ahead, aside = number.ahead[direction], number.left[direction]
        shown = cos[0] * ahead + sin[0] * aside + level[0]
        for b in range(1, LIDAR_BINS):
            shown = max(shown, cos[b] * ahead + sin[b] * aside + level[b])
        exponent[3 * LIDAR_BINS + direction] = shown
    near = gain * exp(behind)
    # The graph's last matrix product: a number in it that is infinite makes NaN of all that it gives.
    spoilt = zero * x + zero * y + zero * near
    return (
        (two * towards + spoilt) * sight,
        (two * left + spoilt) * sight,
        (near + spoilt) * sight,
        (gain * x + spoilt) * sight,
        (gain * y + spoilt) * sight,
    )


@compiled
def _largest(seen: Row) -> int:
    """The bin of the goal's largest reading, the first of several."""
    largest, nearest = seen[_GOAL], 0
    for b in range(1, LIDAR_BINS):
        largest = max(largest, seen[_GOAL + b])
    for b in range(LIDAR_BINS - 1, -1, -1):
        nearest = b if seen[_GOAL + b] == largest else nearest
    return nearest


@compiled
def _bearing(before: float, reading: float, after: float, half_bin: float, tiny: float) -> float:
    """Of a bin's object, from the bin's middle [rad]: the middle of what the neighbours leave possible."""
    most = max(reading, tiny)
    bearing: float = (min(after, most) - min(before, most)) / most * half_bin
    return bearing


@compiled
def _apart(x: float, y: float, end_x: float, end_y: float, zero: float, one: float, tiny: float) -> float:
    """Distance [m] of a place from the segment between the robot and an end."""
    share = (x * end_x + y * end_y) / (end_x * end_x + end_y * end_y + tiny)
    share = _clip(share, zero, one)
    x, y = x - share * end_x, y - share * end_y
    return math.sqrt(x * x + y * y)


@compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
