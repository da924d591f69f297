"""The backup manoeuvres, and how far each of them stays from every obstacle.

A backup is a feedback law of the reduced model, so what is left of a manoeuvre after one step is the same
law's manoeuvre from the new state: a certificate carries over from step to step. Each runs for any number of
control steps and then coasts; to coast at once is the shortest of all of them.

- ``FORWARD`` and ``REVERSE``: full thrust along or against the heading, which is held. The one against the
  motion brakes; the one along it takes the stop point past or away from an obstacle.
- ``TURN``: turn the heading's axis into the line of motion and thrust against the motion meanwhile.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from filter.compiled import compiled
from filter.config import Settings
from filter.obstacles import FAR, gap, gap_segment, least_gap
from filter.robot import Robot, Stopping, follow

FloatArray = NDArray[np.float64]

_TINY = 1e-9
_AT_REST = 0.02
"""Way to the stop point below which the robot counts as at rest [m]: 4 cm/s."""
_SHARE = 0.5
"""Share of the speed along its axis that a turning robot brakes within a step, at most."""
FORWARD, REVERSE, TURN = 0, 1, 2
BACKUPS = 3
"""How many backup manoeuvres there are."""
STEPS = 20
"""Control steps for which a backup thrusts at most: 0.4 s; a full brake from top speed takes 0.36 s."""


@compiled
def steered(robot: Robot, error: float) -> float:
    """The turn u2 in [-1, 1] that takes an error [rad] from the heading within a control step, or near."""
    gain = (robot.gear * robot.gear + robot.yaw_drag) / robot.gear
    return min(max(gain * error / (robot.physics_step * robot.substeps), -1.0), 1.0)


@compiled
def law(settings: Settings, kind: int, at: Stopping) -> tuple[float, float]:
    """The control of a backup.

    Args:
        settings: the filter's numbers.
        kind: which backup.
        at: the reduced state.

    Returns:
        The share of full thrust, and u2, both in [-1, 1].
    """
    if kind == FORWARD:
        return 1.0, 0.0
    if kind == REVERSE:
        return -1.0, 0.0
    robot = settings.robot
    vx = at.zx - at.x
    vy = at.zy - at.y
    c = math.cos(at.heading)
    s = math.sin(at.heading)
    ahead = vx * c + vy * s
    aside = vy * c - vx * s
    # At rest there is no line of motion to turn into, and turning would only swing the origin round.
    fade = min(max(math.hypot(vx, vy) / _AT_REST - 1.0, 0.0), 1.0)
    # The axis has no front: against the motion is as good as along it.
    error = math.atan2(aside, ahead) if ahead >= 0.0 else math.atan2(-aside, -ahead)
    turn = steered(robot, error)
    reach = robot.gear * robot.force_limit / robot.drag * robot.physics_step * robot.substeps
    return fade * min(max(-_SHARE * ahead / reach, -1.0), 1.0), fade * turn


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
    for step in range(STEPS + 1):
        rest = settings.travel_error * (travelled + math.hypot(at.zx - at.x, at.zy - at.y))
        floor = (best if exact else max(best, enough - _TINY)) + rest
        end, at_end = least_gap(obstacles, count, at.x, at.y, at.zx, at.zy, first, floor)
        first = at_end
        value = min(end, path) - rest
        if value > best:
            best = value
            blocker = at_end if end < path else on_path
            steps = step
        if best >= enough or step == STEPS:
            break
        thrust, turn = law(settings, kind, at)
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
        thrust, turn = law(settings, kind, at)
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
