"""How far each backup manoeuvre of the system stays from every obstacle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from decision import PLAN_STEPS
from system.compiled import compiled
from filter.config import Settings
from system.obstacles import FAR, gap, gap_segment, least_gap
from system.backups import BACKUPS, TURN, law
from system.point_robot import Stopping, follow

FloatArray = NDArray[np.float64]

_TINY = 1e-9


@compiled
def clearance(
    settings: Settings,
    kind: int,
    obstacles: FloatArray,
    count: int,
    start: Stopping,
    enough: float,
    first: int,
    exact: bool,
) -> tuple[float, int, int]:
    """The best clearance that a backup reaches over the number of steps for which it thrusts.

    Args:
        settings: the filter's numbers.
        kind: which backup.
        obstacles: (M, COLUMNS), radii with the margin.
        count: how many of them there are.
        start: the reduced state.
        enough: stop looking at a clearance of this much [m].
        first: the obstacle to look at first; -1 for any.
        exact: whether the clearance matters below ``enough``, too; else it is only known to be below.

    Returns:
        The clearance [m], after ``travel_error``; the obstacle that bounds it, -1 if none; the steps of
        thrust.
    """
    at = start
    best = -FAR
    blocker = first
    steps = 0
    path = FAR
    on_path = -1
    travelled = 0.0
    for step in range(PLAN_STEPS + 1):
        rest = settings.travel_error * (travelled + math.hypot(at.zx - at.x, at.zy - at.y))
        floor = (best if exact else max(best, enough - _TINY)) + rest
        end, at_end = least_gap(obstacles, count, at.x, at.y, at.zx, at.zy, first, floor)
        first = at_end
        value = min(end, path) - rest
        if value > best:
            best = value
            blocker = at_end if end < path else on_path
            steps = step
        if best >= enough or step == PLAN_STEPS:
            break
        thrust, turn = law(settings.robot, kind, at)
        after = follow(settings.robot, at, thrust, turn)
        distance, nearest = least_gap(obstacles, count, at.x, at.y, after.x, after.y, first, best)
        if distance < path:
            path = distance
            on_path = nearest
        travelled += math.hypot(after.x - at.x, after.y - at.y)
        at = after
        left = path - settings.travel_error * travelled
        if left <= best or not (exact or left >= enough):
            break
    return best, blocker, steps


@compiled
def clearances(
    settings: Settings,
    kind: int,
    steps: int,
    obstacles: FloatArray,
    count: int,
    start: Stopping,
    out: FloatArray,
) -> None:
    """Write the clearance [m] of a backup with a given number of steps of thrust from each obstacle."""
    at = start
    travelled = 0.0
    for i in range(count):
        out[i] = gap(obstacles, i, at.x, at.y)
    for _ in range(steps):
        thrust, turn = law(settings.robot, kind, at)
        after = follow(settings.robot, at, thrust, turn)
        for i in range(count):
            out[i] = min(out[i], gap_segment(obstacles, i, at.x, at.y, after.x, after.y, out[i]))
        travelled += math.hypot(after.x - at.x, after.y - at.y)
        at = after
    rest = settings.travel_error * (travelled + math.hypot(at.zx - at.x, at.zy - at.y))
    for i in range(count):
        out[i] = min(out[i], gap_segment(obstacles, i, at.x, at.y, at.zx, at.zy, out[i])) - rest


@compiled
def best_backup(
    settings: Settings, obstacles: FloatArray, count: int, start: Stopping, enough: float
) -> tuple[float, int, int, int]:
    """The backup with the largest clearance.

    Args:
        settings: the filter's numbers.
        obstacles: (M, COLUMNS), radii with the margin.
        count: how many of them there are.
        start: the reduced state.
        enough: stop looking at a clearance of this much [m]; `FAR` for the exact one. Below it, the clearance
            is only known to be below.

    Returns:
        The clearance [m], the obstacle that bounds it, which backup, and for how many steps it thrusts.
    """
    best = -2.0 * FAR
    blocker = -1
    # No manoeuvre is farther from an obstacle than the robot is now.
    here, nearest = least_gap(obstacles, count, start.x, start.y, start.x, start.y, -1, -FAR)
    exact = enough >= FAR
    if here < enough and not exact:
        return here, nearest, 0, 0
    enough = min(enough, here - _TINY)
    chosen = 0
    steps = 0
    # The one that brakes comes first: it is the likeliest to do.
    ahead = (start.zx - start.x) * math.cos(start.heading) + (start.zy - start.y) * math.sin(start.heading)
    for turn in range(BACKUPS):
        kind = turn if ahead < 0.0 or turn == TURN else 1 - turn
        first = blocker if blocker >= 0 else nearest
        value, at, count_steps = clearance(settings, kind, obstacles, count, start, enough, first, exact)
        if value > best:
            best, blocker, chosen, steps = value, at, kind, count_steps
        if best >= enough:
            break
    return best, blocker, chosen, steps
