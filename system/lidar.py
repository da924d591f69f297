"""What the pseudo-lidar leaves possible: every place in which a hazard can be, given the readings.

A hazard at distance d in bin b, at the share alpha of the bin's width, gives the reading s = 1 - d / 3 to
its own bin, alpha s to the next and (1 - alpha) s to the one before, and a bin shows the largest of what it
is given. So whatever else there is, a hazard in bin b obeys

    s <= R[b],   alpha s <= R[b + 1],   (1 - alpha) s <= R[b - 1].

For each s the share alpha is thus in [1 - R[b-1] / s, R[b+1] / s]: one point where a single hazard is alone,
and a wedge that widens with the distance behind it, where others could hide. The union over the bins holds
every hazard within the lidar's range, aliasing and hazards that share a bin included.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE
from system.compiled import compiled
from system.obstacles import FloatArray, put

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

PIECES = 4
"""Pieces along the range that a bin's region is cut into."""
SPLITS = 8
"""Pieces across the bin's width, at most."""
_WASTE = 0.004
"""How much nearer than its region a cone may come for its round front [m]; more far off."""
CONES = LIDAR_BINS * PIECES * SPLITS
"""The most obstacles that one scan gives."""
_EDGES = (0.0, 0.12, 0.35, 0.8)
_ROUNDING = 1e-9
_EXPLAINED = 1e-4
"""Reading above what is accounted for that still counts as accounted for: 0.3 mm."""


@compiled
def contradictory(readings: FloatArray, tolerance: float) -> bool:
    """Whether some bin (of 16, or of none) has a reading that no hazards can give.

    Such a reading is outside of [0, 1], or above the sum of its neighbours': whatever shows in a bin shows in
    the two beside it as well, in shares that add up to it. Up to ``tolerance`` it counts as a rounding.
    """
    size = readings.size
    for b in range(size):
        beside = readings[(b + size - 1) % size] + readings[(b + 1) % size]
        if not -tolerance <= readings[b] <= min(1.0, beside) + tolerance:
            return True
    return False


@compiled
def shares(reading: float, before: float, after: float) -> tuple[float, float]:
    """The shares of the bin's width in which a hazard of this reading can be, given the neighbours'."""
    low = max(1.0 - before / reading - _ROUNDING, 0.0)
    high = min(after / reading + _ROUNDING, 1.0)
    return low, high


@compiled
def unexplained(readings: FloatArray, given: FloatArray, position: float, bearing: float) -> BoolArray:
    """Which bins (16,) show more than the given hazards (n, 2) [m] account for.

    Args:
        readings: (16,) the hazards' lidar.
        given: (n, 2) hazards in the body frame [m]; NaN for absent ones.
        position: bound on the error of a hazard's distance [m].
        bearing: bound on the error of its bearing [rad].
    """
    shown = np.zeros(LIDAR_BINS)
    wide = 2.0 * bearing / BIN_WIDTH + _ROUNDING
    for i in range(given.shape[0]):
        distance = math.hypot(given[i, 0], given[i, 1]) - 2.0 * position
        # Not so for a NaN.
        if distance < LIDAR_RANGE:
            reading = 1.0 - max(distance, 0.0) / LIDAR_RANGE
            place = math.atan2(given[i, 1], given[i, 0]) / BIN_WIDTH
            first = math.floor(place - wide)
            last = math.floor(place + wide)
            for b in range(first, last + 1):
                shown[b % LIDAR_BINS] = max(shown[b % LIDAR_BINS], reading)
            before = (1.0 - (place - wide - first)) * reading
            after = (place + wide - last) * reading
            shown[(first - 1) % LIDAR_BINS] = max(shown[(first - 1) % LIDAR_BINS], before)
            shown[(last + 1) % LIDAR_BINS] = max(shown[(last + 1) % LIDAR_BINS], after)
    return readings > shown + _EXPLAINED


@compiled
def decode(
    readings: FloatArray,
    wanted: BoolArray,
    reach: float,
    grow: float,
    spread: float,
    out: FloatArray,
    source: IntArray,
    count: int,
    label: int,
) -> int:
    """Cover every place in which a hazard can be with round cones.

    Args:
        readings: (16,) the hazards' lidar.
        wanted: (16,) the bins to look at.
        reach: how far out to look [m].
        grow: radius of a hazard and margin [m].
        spread: bound on the error of a bearing [rad]; adds its arc to the radius.
        out: (>= count + CONES, COLUMNS) receives the obstacles.
        source: (>= count + CONES,) receives each one's bin, and the label added.
        count: how many obstacles there are already.
        label: added to the bins.

    Returns:
        How many obstacles there are then.
    """
    for b in range(LIDAR_BINS):
        if not wanted[b]:
            continue
        before = readings[(b + LIDAR_BINS - 1) % LIDAR_BINS]
        after = readings[(b + 1) % LIDAR_BINS]
        # Where the three leave no place, each of them may be what is off.
        slack = max(readings[b] - before - after, 0.0)
        before += slack
        after += slack
        strongest = min(readings[b], 1.0)
        if strongest <= 0.0:
            continue
        nearest = LIDAR_RANGE * (1.0 - strongest)
        for piece in range(PIECES):
            start = nearest + _EDGES[piece]
            if start > reach + _ROUNDING:
                break
            end = min(nearest + _EDGES[piece + 1] if piece + 1 < PIECES else max(reach, start), LIDAR_RANGE)
            if start >= end and piece > 0:
                break
            count = _cover(b, start, end, before, after, grow, spread, out, source, count, label)
    return count


@compiled
def _cover(
    b: int,
    start: float,
    end: float,
    before: float,
    after: float,
    grow: float,
    spread: float,
    out: FloatArray,
    source: IntArray,
    count: int,
    label: int,
) -> int:
    """Cover the part of a bin's region between two distances [m] with cones side by side.

    Over the distance the upper share is convex and the lower one concave, so straight lines between the ends
    hold the region; ``bend`` is what a cone's straight axis misses of a bearing that is linear in the
    distance.
    """
    weakest = max(1.0 - end / LIDAR_RANGE, 1e-6)
    low, high = shares(weakest, before, after)
    near_low, near_high = shares(1.0 - start / LIDAR_RANGE, before, after)
    if near_low > near_high:
        near_low = near_high = 0.5 * (near_low + near_high)
    # Between the two ends the region lies within straight lines, unless the bin's own edge cuts it on the
    # way.
    if low <= 0.0:
        near_low = 0.0
    if high >= 1.0:
        near_high = 1.0
    waste = _WASTE + 0.1 * max(start - grow, 0.0)
    parts = min(max(math.ceil((near_high - near_low) * BIN_WIDTH * start / (2.0 * waste)), 1), SPLITS)
    for part in range(parts):
        left = low + (high - low) * part / parts
        right = low + (high - low) * (part + 1) / parts
        # The region is narrower near by: a cone there need only reach what is left of its part.
        close_left = min(max(left, near_low), near_high)
        close_right = min(max(right, near_low), near_high)
        first = (b + 0.5 * (close_left + close_right)) * BIN_WIDTH
        last = (b + 0.5 * (left + right)) * BIN_WIDTH
        x, y = start * math.cos(first), start * math.sin(first)
        dx, dy = end * math.cos(last) - x, end * math.sin(last) - y
        shift = abs(last - first)
        bend = 0.25 * shift * (end - start) + 0.125 * end * shift * shift
        near = grow + bend + start * (0.5 * (close_right - close_left) * BIN_WIDTH + spread)
        far = grow + bend + end * (0.5 * (right - left) * BIN_WIDTH + spread)
        put(out, count, x, y, dx, dy, near, far - near)
        source[count] = label + b
        count += 1
    return count


@compiled
def place_alone(readings: NDArray[np.floating[Any]], b: int) -> tuple[float, float]:
    """Where a thing is that is alone in bin b of a scan (16,), whose reading is above 0: x, y [m]."""
    reading = np.float64(readings[b])
    bearing = (b + readings[(b + 1) % LIDAR_BINS] / reading) * BIN_WIDTH
    distance = LIDAR_RANGE * (1.0 - reading)
    return distance * math.cos(bearing), distance * math.sin(bearing)


@compiled
def decode_goal(readings: FloatArray) -> tuple[bool, float, float]:
    """Where the goal is, which is alone in its lidar: whether it is in range, and its place x, y [m]."""
    best = 0
    for b in range(1, LIDAR_BINS):
        if readings[b] > readings[best]:
            best = b
    strongest = readings[best]
    if strongest <= 0.0:
        return False, 0.0, 0.0
    x, y = place_alone(readings, best)
    return True, x, y


@compiled
def likeliest(
    readings: FloatArray,
    wanted: BoolArray,
    radius: float,
    out: FloatArray,
    source: IntArray,
    count: int,
    label: int,
) -> int:
    """One disc for each hazard that the readings tell apart: a guess to plan with, not to be safe by.

    A bin that shows more than its neighbours' hazards explain has one of its own, in the middle of where it
    can be.

    Args:
        readings: (16,) the hazards' lidar.
        wanted: (16,) the bins to look at.
        radius: of the discs [m].
        out: (>= count + 16, 3) receives centres and radii [m].
        source: (>= count + 16,) receives each one's bin, and the label added.
        count: how many discs there are already.
        label: added to the bins.

    Returns:
        How many discs there are then.
    """
    for b in range(LIDAR_BINS):
        if not wanted[b]:
            continue
        before = readings[(b + LIDAR_BINS - 1) % LIDAR_BINS]
        after = readings[(b + 1) % LIDAR_BINS]
        strongest = min(readings[b], before + after, 1.0)
        spill = max(
            before - readings[(b + LIDAR_BINS - 2) % LIDAR_BINS], after - readings[(b + 2) % LIDAR_BINS]
        )
        if strongest <= spill + 1e-6 and strongest < max(before, after):
            continue
        if strongest <= 0.0:
            continue
        low, high = shares(strongest, before, after)
        bearing = (b + 0.5 * (low + high)) * BIN_WIDTH
        distance = LIDAR_RANGE * (1.0 - strongest)
        out[count] = (distance * math.cos(bearing), distance * math.sin(bearing), radius)
        source[count] = label + b
        count += 1
    return count
