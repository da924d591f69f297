"""Obstacles as round cones: discs whose radius changes along a segment; a known hazard is one disc.

An obstacle is a row of `COLUMNS` numbers: the first centre (x, y), the way to the last centre (dx, dy), the
radius at the first centre, its growth up to the last, and the distance of its edge from the frame's origin,
which tells at once that most obstacles are too far to matter. All in metres, in the frame of the decision.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from system.compiled import compiled

FloatArray = NDArray[np.float64]

COLUMNS = 7
"""Numbers that describe one obstacle."""
FAR = 1e9
"""Distance where there is no obstacle [m]."""
_BRACKET = 0.02
"""Length to which the nearest point of a segment to a cone is bracketed [m]; errs by 0.25 mm."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


@compiled
def gap(obstacles: FloatArray, i: int, x: float, y: float) -> float:
    """Distance from a point to the edge of obstacle i [m]; negative inside."""
    qx = x - obstacles[i, 0]
    qy = y - obstacles[i, 1]
    if obstacles[i, 2] == 0.0 and obstacles[i, 3] == 0.0:
        return math.sqrt(qx * qx + qy * qy) - float(obstacles[i, 4] + max(obstacles[i, 5], 0.0))
    length: float = math.sqrt(obstacles[i, 2] * obstacles[i, 2] + obstacles[i, 3] * obstacles[i, 3])
    if length < 1e-9:
        return math.sqrt(qx * qx + qy * qy) - float(obstacles[i, 4] + max(obstacles[i, 5], 0.0))
    growth = obstacles[i, 5] / length
    along = (qx * obstacles[i, 2] + qy * obstacles[i, 3]) / length
    aside = abs(qx * obstacles[i, 3] - qy * obstacles[i, 2]) / length
    if growth >= 1.0:
        at = length
    elif growth <= -1.0:
        at = 0.0
    else:
        at = min(max(along + aside * growth / math.sqrt(1.0 - growth * growth), 0.0), length)
    return math.sqrt((along - at) * (along - at) + aside * aside) - float(obstacles[i, 4] + growth * at)


@compiled
def gap_segment(
    obstacles: FloatArray, i: int, x0: float, y0: float, x1: float, y1: float, bound: float
) -> float:
    """Least distance from a segment to the edge of obstacle i [m]; negative if it enters.

    It need not be exact where it is above ``bound`` [m].
    """
    dx = x1 - x0
    dy = y1 - y0
    square = dx * dx + dy * dy
    if square < 1e-12:
        return gap(obstacles, i, x0, y0)
    if obstacles[i, 2] == 0.0 and obstacles[i, 3] == 0.0:
        at = ((obstacles[i, 0] - x0) * dx + (obstacles[i, 1] - y0) * dy) / square
        at = min(max(at, 0.0), 1.0)
        qx = x0 + at * dx - obstacles[i, 0]
        qy = y0 + at * dy - obstacles[i, 1]
        return math.sqrt(qx * qx + qy * qy) - float(obstacles[i, 4] + max(obstacles[i, 5], 0.0))
    # A cone is convex, so the distance along the segment is a convex function: golden section search.
    length = math.sqrt(square)
    start = gap(obstacles, i, x0, y0)
    end = gap(obstacles, i, x1, y1)
    least = min(start, end)
    # It changes by at most the way travelled, so it may be out of the question that it gets below the bound.
    if 0.5 * (start + end - length) >= min(least, bound) or length < _BRACKET:
        return least
    low = 0.0
    high = 1.0
    left = 1.0 - _GOLDEN
    right = _GOLDEN
    at_left = gap(obstacles, i, x0 + left * dx, y0 + left * dy)
    at_right = gap(obstacles, i, x0 + right * dx, y0 + right * dy)
    while (high - low) * length > _BRACKET:
        if at_left < at_right:
            high = right
            right = left
            at_right = at_left
            left = high - _GOLDEN * (high - low)
            at_left = gap(obstacles, i, x0 + left * dx, y0 + left * dy)
        else:
            low = left
            left = right
            at_left = at_right
            right = low + _GOLDEN * (high - low)
            at_right = gap(obstacles, i, x0 + right * dx, y0 + right * dy)
    return min(least, at_left, at_right)


@compiled
def least_gap(
    obstacles: FloatArray, count: int, x0: float, y0: float, x1: float, y1: float, first: int, floor: float
) -> tuple[float, int]:
    """Least distance from a segment to any obstacle's edge.

    Args:
        obstacles: (M, COLUMNS).
        count: how many of them there are.
        x0: start [m].
        y0: start [m].
        x1: end [m].
        y1: end [m].
        first: the obstacle to look at first, the likeliest to be the nearest; -1 for any.
        floor: stop looking once the distance is at most this [m].

    Returns:
        The distance [m], and which obstacle; exact if above ``floor``. `FAR` and -1 if there is none.
    """
    least = FAR
    nearest = -1
    if first >= 0:
        least = gap_segment(obstacles, first, x0, y0, x1, y1, FAR)
        nearest = first
        if least <= floor:
            return least, nearest
    out = math.sqrt(max(x0 * x0 + y0 * y0, x1 * x1 + y1 * y1))
    for i in range(count):
        if i == first or obstacles[i, 6] - out >= least:
            continue
        distance = gap_segment(obstacles, i, x0, y0, x1, y1, least)
        if distance < least:
            least = distance
            nearest = i
            if least <= floor:
                break
    return least, nearest
