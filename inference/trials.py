"""Observations on which two ways to compute the same networks are held against each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.features import FeatureNumbers
from pointgoal.observation import LIDAR_BINS, layout

FloatArray = NDArray[np.float64]

_LAYOUT = layout(1)
_GOAL, _HAZARDS, _VELOCITY = map(_LAYOUT.slice, ("goal_lidar", "hazards_lidar", "velocimeter"))
_LIDARS = slice(_GOAL.start, _HAZARDS.stop)
_EACH = 32
"""Observations of each kind."""


def trials(numbers: FeatureNumbers) -> FloatArray:
    """Observations [N, 60], always the same: such as a robot makes, and what else a caller might send.

    Args:
        numbers: for the mean and the spread of what the networks saw in training.
    """
    rng = np.random.default_rng(0)
    center, inverse = np.array(numbers.center), np.array(numbers.inverse)

    def usual(count: int = _EACH) -> FloatArray:
        made: FloatArray = center + rng.normal(0.0, 1.5, (count, _LAYOUT.size)) / inverse
        made[:, _GOAL], made[:, _HAZARDS] = _scans(rng, count, 1), _scans(rng, count, 8)
        return made

    def changed(where: slice, numbers: FloatArray | float) -> FloatArray:
        made = usual()
        made[:, where] = numbers
        return made

    def anywhere(low: float, high: float, size: int) -> FloatArray:
        return rng.uniform(low, high, (_EACH, size))

    touching = usual()
    touching[:, _LIDARS][anywhere(0.0, 1.0, 2 * LIDAR_BINS) < 0.3] = 1.0
    kinds = (
        np.zeros((1, _LAYOUT.size)),
        usual(8 * _EACH),
        touching,
        changed(_GOAL, 0.0),
        changed(_HAZARDS, 0.0),
        changed(_LIDARS, 0.0),
        changed(_GOAL, rng.choice((0.0, 0.4, 0.9), (_EACH, LIDAR_BINS))),  # the largest one stands twice
        changed(_LIDARS, anywhere(0.0, 1.0, 2 * LIDAR_BINS)),
        changed(_LIDARS, anywhere(-1.0, 2.0, 2 * LIDAR_BINS)),
        *(changed(_VELOCITY, anywhere(-fast, fast, 3)) for fast in (3.0, 30.0, 1e15, 1e30, 1e37)),
        *(changed(_HAZARDS, anywhere(0.0, strong, LIDAR_BINS)) for strong in (1e3, 1e37)),
    )
    return np.concatenate(kinds)


def _scans(rng: np.random.Generator, count: int, things: int) -> FloatArray:
    """Readings [count, 16] of lidars that show some things each."""
    readings, rows = np.zeros((count, LIDAR_BINS)), np.arange(count)
    for _ in range(things):
        reading, share, at = rng.random(count), rng.random(count), rng.integers(0, LIDAR_BINS, count)
        for b, shown in ((at, reading), (at + 1, share * reading), (at - 1, (1.0 - share) * reading)):
            place = rows, b % LIDAR_BINS
            readings[place] = np.maximum(readings[place], shown)
    return readings
