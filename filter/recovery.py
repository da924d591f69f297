"""The way out when nothing is certified: the manoeuvre that is least deep in, and soonest clear of, any obstacle.

It is used inside a hazard, at a speed that no backup can hold, and where the sensors' errors have eaten the margin.
The backups are among the candidates, so while one of them is still good it is what is committed to; the others
turn to one of a ring of headings and thrust, forwards or backwards, once they point roughly there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from filter.backups import BACKUPS, law
from filter.compiled import compiled
from filter.config import Settings
from filter.obstacles import FAR, least_gap
from filter.robot import State, Stopping, follow, stopping

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
    """A candidate's share of full thrust and change of heading [rad]."""
    if candidate < BACKUPS:
        return law(settings, candidate, at)
    if candidate == BACKUPS:
        return 0.0, 0.0
    robot = settings.robot
    most = robot.gear / (robot.gear * robot.gear + robot.yaw_drag) * robot.physics_step * robot.substeps
    ring = (candidate - BACKUPS - 1) // 2
    forwards = 1.0 if (candidate - BACKUPS - 1) % 2 == 0 else -1.0
    error = heading + 2.0 * math.pi * ring / HEADINGS - at.heading
    error = math.atan2(math.sin(error), math.cos(error))
    thrust = forwards if math.cos(error) > _ALIGNED else 0.0
    return thrust, min(max(error, -most), most)


@compiled
def _harm(
    settings: Settings, obstacles: FloatArray, count: int, start: Stopping, candidate: int, least: float
) -> float:
    """Depth [m] below ``keep_off``, summed over a candidate's steps, and the delay until it may coast clear."""
    seconds = settings.robot.physics_step * settings.robot.substeps
    at = start
    harm = 0.0
    nearest = -1
    deepest = 0.0
    for step in range(_STEPS):
        gap, nearest = least_gap(obstacles, count, at.x, at.y, at.x, at.y, nearest, -FAR)
        if step == 0:
            deepest = max(-gap, 0.0)
        harm += max(settings.keep_off - gap, 0.0) + _DELAY + _DEEPER * max(-gap - deepest, 0.0)
        deepest = max(deepest, -gap)
        if harm >= least:
            return harm
        if gap >= 0.0:
            rest, _ = least_gap(obstacles, count, at.x, at.y, at.zx, at.zy, nearest, 0.0)
            if rest >= 0.0:
                return harm
        thrust, turn = _control(settings, candidate, start.heading, at)
        at = follow(settings.robot, at, thrust, turn, seconds)
    # Still not clear: what is left of the motion counts as well.
    rest, _ = least_gap(obstacles, count, at.x, at.y, at.zx, at.zy, nearest, -FAR)
    return harm + _DEEPER * max(-rest - deepest, 0.0) + _STEPS * max(-rest, 0.0)


@compiled
def drive_out(settings: Settings, obstacles: FloatArray, count: int, state: State) -> tuple[float, float]:
    """The first action (u1, u2) of the least harmful candidate."""
    start = stopping(settings.robot, state)
    least = FAR
    best = BACKUPS
    for candidate in range(BACKUPS + 1 + 2 * HEADINGS):
        harm = _harm(settings, obstacles, count, start, candidate, least)
        if harm < least:
            least = harm
            best = candidate
    robot = settings.robot
    thrust, turn = _control(settings, best, start.heading, start)
    most = robot.gear / (robot.gear * robot.gear + robot.yaw_drag) * robot.physics_step * robot.substeps
    return thrust * robot.force_limit, turn / most
