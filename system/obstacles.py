"""Obstacles as round cones: discs whose radius changes along a segment; a known hazard is one disc.

An obstacle is a row of `COLUMNS` numbers: the first centre (x, y), the way to the last centre (dx, dy), the
radius at the first centre, its growth up to the last, and the distance of its edge from the frame's origin,
which tells at once that most obstacles are too far to matter. All in metres, in the frame of the decision.
Behind them stands what follows from these and is asked for again and again: the way's direction and length,
and sine, cosine and tangent of the angle between the axis and the straight side. `put` writes such a row.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from system.compiled import compiled

FloatArray = NDArray[np.float64]

COLUMNS = 13
"""Numbers that describe one obstacle."""
FAR = 1e9
"""Distance where there is no obstacle [m]."""


@compiled
def put(
    obstacles: FloatArray, i: int, x: float, y: float, dx: float, dy: float, radius: float, growth: float
) -> None:
    """Write obstacle i; a cone that one of its two discs holds whole becomes that disc. All in metres."""
    one = obstacles[i]
    length = math.sqrt(dx * dx + dy * dy)
    if length < 1e-9 or abs(growth) >= length:
        if growth > 0.0:
            x, y, radius = x + dx, y + dy, radius + growth
        one[:] = 0.0
        one[0], one[1], one[4] = x, y, radius
    else:
        sine = growth / length
        cosine = math.sqrt(1.0 - sine * sine)
        one[0], one[1], one[2], one[3], one[4], one[5] = x, y, dx, dy, radius, growth
        one[7], one[8], one[9] = dx / length, dy / length, length
        one[10], one[11], one[12] = sine, cosine, sine / cosine
    one[6] = gap(obstacles, i, 0.0, 0.0)


@compiled
def gap(obstacles: FloatArray, i: int, x: float, y: float) -> float:
    """Distance from a point to the edge of obstacle i [m]; negative inside."""
    qx, qy, length = x - obstacles[i, 0], y - obstacles[i, 1], obstacles[i, 9]
    along = qx * obstacles[i, 7] + qy * obstacles[i, 8]
    aside = abs(qx * obstacles[i, 8] - qy * obstacles[i, 7])
    # The centre of the disc that is nearest.
    at = along + aside * obstacles[i, 12]
    if at <= 0.0 or length == 0.0:
        return math.sqrt(qx * qx + qy * qy) - float(obstacles[i, 4])
    if at >= length:
        return math.sqrt((along - length) * (along - length) + aside * aside) - float(
            obstacles[i, 4] + obstacles[i, 5]
        )
    return float(aside * obstacles[i, 11] - along * obstacles[i, 10] - obstacles[i, 4])


@compiled
def gap_segment(
    obstacles: FloatArray, i: int, x0: float, y0: float, x1: float, y1: float, bound: float
) -> float:
    """Least distance from a segment to the edge of obstacle i [m]; negative if it enters.

    It need not be exact where it is above ``bound`` [m].
    """
    dx, dy = x1 - x0, y1 - y0
    qx, qy = x0 - obstacles[i, 0], y0 - obstacles[i, 1]
    square = dx * dx + dy * dy
    if square < 1e-24:
        return gap(obstacles, i, x0, y0)
    # Where the segment is nearest to the first centre.
    at = -(qx * dx + qy * dy) / square
    if obstacles[i, 9] == 0.0:
        at = min(max(at, 0.0), 1.0)
        return math.sqrt((qx + at * dx) ** 2 + (qy + at * dy) ** 2) - float(obstacles[i, 4])
    # It changes by at most the way travelled, so it may be out of the question that it gets below the bound.
    length = math.sqrt(square)
    start = gap(obstacles, i, x0, y0)
    if start - length >= bound:
        return start
    end = gap(obstacles, i, x1, y1)
    least = min(start, end)
    if 0.5 * (start + end - length) >= min(least, bound):
        return least
    # A cone is convex, and its distance along the segment smooth but where that crosses the axis; beside the
    # straight sides it is linear. So it is least at an end, there, or where a centre is nearest.
    if 0.0 < at < 1.0:
        least = min(least, gap(obstacles, i, x0 + at * dx, y0 + at * dy))
    at += (obstacles[i, 2] * dx + obstacles[i, 3] * dy) / square
    if 0.0 < at < 1.0:
        least = min(least, gap(obstacles, i, x0 + at * dx, y0 + at * dy))
    aside, rate = qx * obstacles[i, 8] - qy * obstacles[i, 7], dx * obstacles[i, 8] - dy * obstacles[i, 7]
    if aside * (aside + rate) < 0.0:
        at = -aside / rate
        least = min(least, gap(obstacles, i, x0 + at * dx, y0 + at * dy))
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
