"""How far each backup manoeuvre of the system stays from every obstacle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from decision import PLAN_STEPS
from system.backups import BACKUPS, TURN, law
from system.compiled import compiled
from system.obstacles import FAR, gap, gap_segment, least_gap
from system.point_robot import Stopping, follow

FloatArray = NDArray[np.float64]
Settings = Any
"""A record, in compiled code, that has the ``robot`` and the ``travel_error``."""

_TINY = 1e-9
_SETTLES = 0.04
"""How much further a heading differs once the servo has come to rest, from full rates either way [rad]."""


@compiled
def loss(settings: Settings, steps: int) -> float:
    """What a control step with any action can cost a backup of some steps of thrust along the heading [m].

    The step moves the stop point by at most V dt, V the speed at which full thrust moves it, and turns the
    heading by at most the angle that the servo reaches within it and on its way back to rest, so that each of
    the backup's steps, V dt long, ends so much aside; and the origin swings about the centre of mass.
    """
    robot = settings.robot
    turned = robot.gear * robot.force_limit / robot.yaw_drag * robot.physics_step * robot.substeps + _SETTLES
    way = robot.gear * robot.force_limit / robot.drag * robot.physics_step * robot.substeps
    cost: float = way * (1.0 + turned * steps) * (1.0 + settings.travel_error) + 2.0 * robot.offset * turned
    return cost


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
    charged: bool,
    beaten: float,
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
        charged: whether to take off what any one action might cost first, see `loss`.
        beaten: what another backup reaches [m]: no more than that does not matter.

    Returns:
        The clearance [m], after ``travel_error``; the obstacle that bounds it, -1 if none; the steps of
        thrust. ``beaten`` where it is no more.
    """
    at = start
    best = beaten
    blocker = first
    steps = 0
    path = FAR
    on_path = -1
    travelled = 0.0
    for step in range(PLAN_STEPS + 1):
        rest = settings.travel_error * (travelled + math.hypot(at.zx - at.x, at.zy - at.y))
        if charged:
            rest += loss(settings, step)
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
    settings: Settings, obstacles: FloatArray, count: int, start: Stopping, enough: float, charged: bool
) -> tuple[float, int, int, int]:
    """The backup with the largest clearance.

    Args:
        settings: the filter's numbers.
        obstacles: (M, COLUMNS), radii with the margin.
        count: how many of them there are.
        start: the reduced state.
        enough: stop looking at a clearance of this much [m]; `FAR` for the exact one. Below it, the clearance
            is only known to be below.
        charged: whether to take off what any one action might cost first; then only backups that hold the
            heading count, for which `loss` bounds that.

    Returns:
        The clearance [m], the obstacle that bounds it, which backup, and for how many steps it thrusts.
    """
    best = -FAR
    blocker = -1
    # No manoeuvre is farther from an obstacle than the robot is now.
    here, nearest = least_gap(obstacles, count, start.x, start.y, start.x, start.y, -1, -FAR)
    exact = enough >= FAR
    if here < enough and not exact and not charged:
        return here, nearest, 0, 0
    enough = min(enough, here - _TINY)
    chosen = 0
    steps = 0
    # The one that brakes comes first: it is the likeliest to do.
    ahead = (start.zx - start.x) * math.cos(start.heading) + (start.zy - start.y) * math.sin(start.heading)
    for turn in range(BACKUPS - 1 if charged else BACKUPS):
        kind = turn if ahead < 0.0 or turn == TURN else 1 - turn
        first = blocker if blocker >= 0 else nearest
        value, at, count_steps = clearance(
            settings, kind, obstacles, count, start, enough, first, exact, charged, best
        )
        if value > best:
            best, blocker, chosen, steps = value, at, kind, count_steps
        if best >= enough:
            break
    return best, blocker, chosen, steps
