"""The point robot's backup manoeuvres: feedback laws of the reduced model.

What is left of such a manoeuvre after one step is the same law's manoeuvre from the new state: a certificate
carries over from step to step. Each runs for any number of control steps and then coasts; to coast at once is
the shortest of all of them.

- ``FORWARD`` and ``REVERSE``: full thrust along or against the heading, which is held. The one against the
  motion brakes; the one along it takes the stop point past or away from an obstacle.
- ``TURN``: turn the heading's axis into the line of motion and thrust against the motion meanwhile.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from system.compiled import compiled
from system.point_robot import Robot, State, Stopping, advance, follow, stopping

FloatArray = NDArray[np.float64]

_AT_REST = 0.02
"""Way to the stop point below which the robot counts as at rest [m]: 4 cm/s."""
_SHARE = 0.5
"""Share of the speed along its axis that a turning robot brakes within a step, at most."""
FORWARD, REVERSE, TURN = 0, 1, 2
BACKUPS = 3
"""How many backup manoeuvres there are."""


@compiled
def steered(robot: Robot, error: float) -> float:
    """The turn u2 in [-1, 1] that takes an error [rad] from the heading within a control step, or near."""
    gain = (robot.gear * robot.gear + robot.yaw_drag) / robot.gear
    return min(max(gain * error / (robot.physics_step * robot.substeps), -1.0), 1.0)


def braking(robot: np.void, speed: FloatArray) -> FloatArray:
    """Actions (n, 2) that take half of the speeds ahead (n,) [m/s] within a step, or what thrust can.

    Args:
        robot: the constants, one of `ROBOT`.
        speed: ahead of the robots, negative backwards.
    """
    action = np.zeros((len(speed), 2))
    step = robot["gear"] / robot["mass"] * robot["physics_step"] * robot["substeps"]
    action[:, 0] = np.clip(-_SHARE * speed / step, -robot["force_limit"], robot["force_limit"])
    return action


@compiled
def law(robot: Robot, kind: int, at: Stopping) -> tuple[float, float]:
    """The control of a backup.

    Args:
        robot: the constants.
        kind: which backup.
        at: the reduced state.

    Returns:
        The share of full thrust, and u2, both in [-1, 1].
    """
    if kind == FORWARD:
        return 1.0, 0.0
    if kind == REVERSE:
        return -1.0, 0.0
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
def write_plan(
    robot: Robot, state: State, u1: float, u2: float, backup: int, steps: int, plan: FloatArray
) -> None:
    """Write down, action by action, a backup of so many steps from where an action leads.

    ``plan`` (PLAN_STEPS, 2) receives it, and zeros behind it.
    """
    plan[:] = 0.0
    if steps > 0:
        at = stopping(robot, advance(robot, state, u1, u2, robot.substeps))
        for step in range(steps):
            thrust, turn = law(robot, backup, at)
            at = follow(robot, at, thrust, turn)
            plan[step, 0] = thrust * robot.force_limit
            plan[step, 1] = turn
