"""What to do when nothing is certified: the committed backup, or the way out.

While a backup still keeps out of the hazards, though not all of the margin, the action that leaves the most
clearance is taken: that continues what was certified last. Inside a hazard, and at a speed that no backup
can hold, it is the manoeuvre that gets least deeper, is least deep, and is soonest clear. The backups are
among its candidates; the others turn to one of a ring of headings and thrust, forwards or backwards, once
they point roughly there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from filter.config import Settings
from system.backups import BACKUPS, law, steered
from system.clearance import best_backup
from system.compiled import compiled
from system.obstacles import FAR, gap, least_gap
from system.point_robot import State, Stopping, advance, follow, stopping

FloatArray = NDArray[np.float64]

HEADINGS = 16
"""Headings that the drives out turn to."""
_STEPS = 40
"""Control steps that a candidate is followed for: 0.8 s; from rest 0.4 s drive out of a hazard's middle."""
_ALIGNED = 0.5
"""Least cosine of the heading's error at which a drive out thrusts."""
_DEEPER = 1e3
"""What each metre costs by which the robot gets deeper than it is: more than any delay."""
_DELAY = 1e-3
"""What each step that is not clear yet costs, against 1 for a metre of depth [m]."""


@compiled
def _control(settings: Settings, candidate: int, heading: float, at: Stopping) -> tuple[float, float]:
    """A candidate's share of full thrust and turn, both in [-1, 1]."""
    if candidate < BACKUPS:
        return law(settings.robot, candidate, at)
    if candidate == BACKUPS:
        return 0.0, 0.0
    ring = (candidate - BACKUPS - 1) // 2
    forwards = 1.0 if (candidate - BACKUPS - 1) % 2 == 0 else -1.0
    error = heading + 2.0 * math.pi * ring / HEADINGS - at.heading
    error = math.atan2(math.sin(error), math.cos(error))
    thrust = forwards if math.cos(error) > _ALIGNED else 0.0
    return thrust, steered(settings.robot, error)


@compiled
def _depths(settings: Settings, obstacles: FloatArray, count: int, x: float, y: float) -> tuple[float, float]:
    """How deep a point is in the obstacles, and how much deeper than the origin, summed over them [m]."""
    depth = 0.0
    deeper = 0.0
    out = math.sqrt(x * x + y * y)
    for i in range(count):
        if obstacles[i, 6] - out >= settings.keep_off:
            continue
        inside = -gap(obstacles, i, x, y)
        depth += max(inside + settings.keep_off, 0.0)
        deeper += max(inside - max(-obstacles[i, 6], 0.0), 0.0)
    return depth, deeper


@compiled
def first_action(settings: Settings, candidate: int, start: Stopping) -> tuple[float, float]:
    """A candidate's first action (u1, u2)."""
    thrust, turn = _control(settings, candidate, start.heading, start)
    return thrust * settings.robot.force_limit, turn


@compiled
def _harm(
    settings: Settings, obstacles: FloatArray, count: int, state: State, candidate: int, least: float
) -> float:
    """What a candidate does: depth over its steps, delay until it may coast clear, and getting deeper.

    The first step is the exact model's, for the servo cannot reverse a turn at once.
    """
    robot = settings.robot
    start = stopping(robot, state)
    thrust, turn = first_action(settings, candidate, start)
    at = stopping(robot, advance(robot, state, thrust, turn, robot.substeps))
    harm = 0.0
    deepest = 0.0
    for _ in range(_STEPS):
        depth, deeper = _depths(settings, obstacles, count, at.x, at.y)
        harm += depth + _DELAY + _DEEPER * max(deeper - deepest, 0.0)
        deepest = max(deeper, deepest)
        if harm >= least:
            return harm
        if depth == 0.0 and least_gap(obstacles, count, at.x, at.y, at.zx, at.zy, -1, 0.0)[0] >= 0.0:
            return harm
        thrust, turn = _control(settings, candidate, start.heading, at)
        at = follow(robot, at, thrust, turn)
    # Still not clear: what is left of the motion counts as well.
    depth, deeper = _depths(settings, obstacles, count, at.zx, at.zy)
    return harm + _STEPS * depth + _DEEPER * max(deeper - deepest, 0.0)


@compiled
def commit(
    settings: Settings, obstacles: FloatArray, count: int, state: State, least: float
) -> tuple[float, float, bool, int, int]:
    """The action, of the backups' first ones and the extremes, that leaves a backup the most clearance.

    What the robot is too near to now counts no more, so from a place within the margin it leads out. Actions
    that keep a clearance ``least`` [m] on their whole way go before those that do not.

    Returns:
        The action (u1, u2); whether it keeps that clearance; the backup that it ends in, and that one's steps
        of thrust.
    """
    robot = settings.robot
    limit = robot.force_limit
    start = stopping(robot, state)
    half = robot.substeps // 2
    most = -FAR
    best_thrust = best_turn = 0.0
    kept = False
    backup = steps = 0
    for candidate in range(BACKUPS + 9):
        if candidate < BACKUPS:
            thrust, turn = first_action(settings, candidate, start)
        else:
            thrust = limit * ((candidate - BACKUPS) // 3 - 1.0)
            turn = (candidate - BACKUPS) % 3 - 1.0
        middle = advance(robot, state, thrust, turn, half)
        after = advance(robot, middle, thrust, turn, robot.substeps - half)
        value, _, kind, thrusts = best_backup(settings, obstacles, count, stopping(robot, after), FAR, False)
        if kept and value <= most:
            continue
        way, _ = least_gap(obstacles, count, state.x, state.y, middle.x, middle.y, -1, -FAR)
        rest, _ = least_gap(obstacles, count, middle.x, middle.y, after.x, after.y, -1, -FAR)
        keeps = min(value, way, rest) >= least
        if value > most or (keeps and not kept):
            if kept and not keeps:
                continue
            most = value
            best_thrust = thrust
            best_turn = turn
            kept = keeps
            backup = kind
            steps = thrusts
    return best_thrust, best_turn, kept, backup, steps


@compiled
def drive_out(settings: Settings, obstacles: FloatArray, count: int, state: State) -> tuple[float, float]:
    """The first action (u1, u2) of the least harmful candidate."""
    least = FAR
    best = BACKUPS
    for candidate in range(BACKUPS + 1 + 2 * HEADINGS):
        harm = _harm(settings, obstacles, count, state, candidate, least)
        if harm < least:
            least = harm
            best = candidate
    return first_action(settings, best, stopping(settings.robot, state))
