"""Which obstacles matter: those within reach of one control step and any backup."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from decision import PLAN_STEPS
from system.compiled import compiled
from system.lidar import decode, unexplained
from system.obstacles import FloatArray, put
from system.point_robot import State

IntArray = NDArray[np.int64]
Settings = Any
"""A record, in compiled code, that has the ``robot``, the ``hazard_radius`` and what is kept of it."""

_THRUST_TIME = 0.02 * (PLAN_STEPS + 1)
"""Longest thrust in a certificate [s]."""


@compiled
def in_own_frame(x: float, y: float, at: State) -> tuple[float, float]:
    """A place (x, y) [m] as a robot that is at a state has it: ahead and to the left of it [m]."""
    dx, dy = x - at.x, y - at.y
    c, s = math.cos(at.heading), math.sin(at.heading)
    return c * dx + s * dy, c * dy - s * dx


@compiled
def surroundings(
    config: Settings, at: State, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray
) -> int:
    """The obstacles near a robot, given ones and what of a scan these do not explain.

    Args:
        config: the filter's numbers.
        at: where the robot is when its next action takes effect, in the frame of the observation.
        given: (n, 2) hazards [m], and
        readings: (16,) or (0,) the hazards' lidar, in that frame.
        out: (M, COLUMNS) receives the obstacles in the robot's own frame at that moment.
        source: (M,) receives each one's hazard, or n + its bin.

    Returns:
        How many there are.
    """
    robot = config.robot
    speed = math.hypot(at.vx, at.vy) + robot.offset * abs(at.yaw_rate)
    thrust = robot.gear * robot.force_limit / robot.drag * _THRUST_TIME
    moved = math.hypot(at.x, at.y)
    reach = robot.mass / robot.drag * speed + thrust + 0.05 + moved
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        distance = math.hypot(x, y)
        radius = config.hazard_radius + config.margin + config.bearing_error * distance
        # Not so for a NaN, which marks an absent hazard.
        if distance - radius <= reach:
            put(out, count, x, y, 0.0, 0.0, radius, 0.0)
            source[count] = i
            count += 1
    if readings.size:
        grow = config.hazard_radius + config.margin
        wanted = unexplained(readings, given, config.position_error, config.bearing_error)
        spread, label = config.bearing_error, len(given)
        count = decode(readings, wanted, reach + grow, grow, spread, out, source, count, label)
    if config.delay_steps > 0:
        for i in range(count):
            x, y = in_own_frame(out[i, 0], out[i, 1], at)
            last_x, last_y = in_own_frame(out[i, 0] + out[i, 2], out[i, 1] + out[i, 3], at)
            put(out, i, x, y, last_x - x, last_y - y, out[i, 4] + config.travel_error * moved, out[i, 5])
    return count
