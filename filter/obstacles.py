"""Obstacles as round cones: discs whose radius changes along a segment. A hazard with a known centre is one disc.

An obstacle is a row of `COLUMNS` numbers: the first centre (x, y), the way to the last centre (dx, dy), the radius
at the first centre, its growth up to the last, and the distance of its edge from the frame's origin, which tells
at once that most obstacles are too far to matter. All in metres, in the frame of the decision.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from filter.compiled import compiled

FloatArray = NDArray[np.float64]

COLUMNS = 7
"""Numbers that describe one obstacle."""
FAR = 1e9
"""Distance where there is no obstacle [m]."""
_STRIDE = 0.01
"""Least advance along a segment when its distance to a cone is searched [m]; errs by 0.1 mm at radius 0.2."""


@compiled
def gap(obstacle: FloatArray, x: float, y: float) -> float:
    """Distance from a point to an obstacle's edge [m]; negative inside."""
    qx = x - obstacle[0]
    qy = y - obstacle[1]
    if obstacle[2] == 0.0 and obstacle[3] == 0.0:
        return math.sqrt(qx * qx + qy * qy) - obstacle[4]
    length = math.sqrt(obstacle[2] * obstacle[2] + obstacle[3] * obstacle[3])
    growth = obstacle[5] / length
    along = (qx * obstacle[2] + qy * obstacle[3]) / length
    aside = abs(qx * obstacle[3] - qy * obstacle[2]) / length
    if growth >= 1.0:
        at = length
    elif growth <= -1.0:
        at = 0.0
    else:
        at = min(max(along + aside * growth / math.sqrt(1.0 - growth * growth), 0.0), length)
    return math.sqrt((along - at) * (along - at) + aside * aside) - obstacle[4] - growth * at


@compiled
def gap_segment(obstacle: FloatArray, x0: float, y0: float, x1: float, y1: float) -> float:
    """Least distance from a segment to an obstacle's edge [m]; negative if it enters."""
    dx = x1 - x0
    dy = y1 - y0
    square = dx * dx + dy * dy
    if square < 1e-12:
        return gap(obstacle, x0, y0)
    if obstacle[2] == 0.0 and obstacle[3] == 0.0:
        at = ((obstacle[0] - x0) * dx + (obstacle[1] - y0) * dy) / square
        at = min(max(at, 0.0), 1.0)
        qx = x0 + at * dx - obstacle[0]
        qy = y0 + at * dy - obstacle[1]
        return math.sqrt(qx * qx + qy * qy) - obstacle[4]
    # The distance changes by at most the way travelled, so nothing below the least so far lies nearer than the rest.
    length = math.sqrt(square)
    least = gap(obstacle, x1, y1)
    at = 0.0
    while at < length:
        here = gap(obstacle, x0 + dx * at / length, y0 + dy * at / length)
        least = min(least, here)
        at += max(here - least, _STRIDE)
    return least


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
        least = gap_segment(obstacles[first], x0, y0, x1, y1)
        nearest = first
        if least <= floor:
            return least, nearest
    out = math.sqrt(max(x0 * x0 + y0 * y0, x1 * x1 + y1 * y1))
    for i in range(count):
        if i == first or obstacles[i, 6] - out >= least:
            continue
        distance = gap_segment(obstacles[i], x0, y0, x1, y1)
        if distance < least:
            least = distance
            nearest = i
            if least <= floor:
                break
    return least, nearest
