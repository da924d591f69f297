"""The pseudo-lidar: what it shows of things, and where things are by what it shows. Needs numpy alone.

A thing at distance d in bin b, at the share α of the bin's width, gives the reading s = 1 − d / 3 m to its
own bin, α s to the next one and (1 − α) s to the one before; a bin shows the largest of what it is given.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, FloatArray

_Floats = TypeVar("_Floats", NDArray[np.float32], NDArray[np.float64])
TINY = 1e-6
"""Least divisor."""


def encode(centres: FloatArray) -> FloatArray:
    """Readings (N, 16) of a lidar for things at (N, k, 2) in the body frame: x ahead, y to the left [m]."""
    readings = np.zeros((len(centres), LIDAR_BINS))
    x, y = centres[..., 0], centres[..., 1]
    start = np.arange(len(centres))[:, None] * LIDAR_BINS
    show(readings.reshape(-1), start, np.arctan2(y, x), np.hypot(x, y))
    return readings


def show(numbers: FloatArray, start: NDArray[np.int64], bearing: FloatArray, distance: FloatArray) -> None:
    """Show things in lidars, beside what they already show.

    Args:
        numbers: (m,) all lidars' numbers, of whatever else as well; changed in place.
        start: where in them the lidar of each thing begins; shape (n, k) or one that broadcasts to it.
        bearing: (n, k) of the things, counter-clockwise from straight ahead [rad]; overwritten.
        distance: (n, k) of the things [m].
    """
    bearing *= 1.0 / BIN_WIDTH
    np.remainder(bearing, LIDAR_BINS, out=bearing)
    ahead = bearing.astype(np.int64)
    alias = bearing - ahead
    # A bearing of -1e-17 has remainder 16.0: the mask wraps it to bin 0, as it wraps the neighbours.
    last = LIDAR_BINS - 1
    reading = np.maximum(LIDAR_RANGE - distance, 0.0) / LIDAR_RANGE
    np.maximum.at(numbers, start + (ahead & last), reading)
    np.maximum.at(numbers, start + (ahead + 1 & last), alias * reading)
    np.maximum.at(numbers, start + (ahead - 1 & last), (1.0 - alias) * reading)


def places(readings: _Floats) -> tuple[_Floats, _Floats, _Floats]:
    """Where the thing in every bin is, if the readings are of one thing a bin.

    Its distance is its reading's, its bearing within the bin the middle of what the neighbours' readings
    leave possible: exact for a thing alone. An empty bin has one at the end of the range.

    Args:
        readings: [..., 16], in single or double precision.

    Returns:
        x ahead and y to the left [m], and the distance [m], each [..., 16], of the same precision.
    """
    # Constants rounded to single precision, as they are in the exported graphs, which compute the same.
    distance = (1 - readings) * np.float32(LIDAR_RANGE)
    divisor = np.maximum(readings, np.float32(TINY))
    upper = np.minimum(np.roll(readings, -1, -1) / divisor, 1)
    lower = np.maximum(1 - np.roll(readings, 1, -1) / divisor, 0)
    bearing = (np.arange(LIDAR_BINS, dtype=np.float32) + (lower + upper) / 2) * np.float32(BIN_WIDTH)
    return distance * np.cos(bearing), distance * np.sin(bearing), distance


def nearest(readings: _Floats) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """Where the nearest thing is: the goal, in its own lidar.

    Args:
        readings: [..., 16], in single or double precision.

    Returns:
        x ahead and y to the left [m], the distance [m], and 1 in sight, else 0, each [..., 1].
    """
    top = readings.argmax(-1)[..., None]
    x, y, distance = (np.take_along_axis(of, top, -1) for of in places(readings))
    return x, y, distance, np.take_along_axis(np.sign(readings), top, -1)
