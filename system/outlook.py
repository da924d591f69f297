"""What a picture of a robot's surroundings shows beside its obstacles. Nothing is decided by it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from system.compiled import entry
from system.lidar import decode_goal, likeliest, unexplained
from system.obstacles import FloatArray
from system.point_robot import State, advance

IntArray = NDArray[np.int64]
Records = NDArray[np.void]

AT_REST = 0.02
"""Speed below which a coasting robot counts as at rest [m/s]."""


@entry
def way(robot: Records, velocity: FloatArray, actions: FloatArray, out: FloatArray) -> int:
    """Where a robot comes by under some actions, and then coasting until it is at rest.

    Args:
        robot: (1,) of `ROBOT`.
        velocity: (3,) ahead, to the left [m/s], and the yaw rate [rad/s].
        actions: (n, 2), one a control step.
        out: (M, 2) receives its origin after each control step, in the frame in which it starts [m].

    Returns:
        How many places there are, at most M.
    """
    state = State(0.0, 0.0, 0.0, velocity[0], velocity[1], velocity[2])
    for step in range(out.shape[0]):
        thrust, turn = 0.0, 0.0
        if step < actions.shape[0]:
            thrust, turn = actions[step]
        elif math.hypot(state.vx, state.vy) < AT_REST:
            return step
        state = advance(robot[0], state, thrust, turn, robot[0].substeps)
        out[step] = (state.x, state.y)
    return int(out.shape[0])


@entry
def discs(
    readings: FloatArray,
    given: FloatArray,
    position: float,
    bearing: float,
    radius: float,
    out: FloatArray,
    source: IntArray,
) -> int:
    """One disc for each hazard that a scan tells apart beside the given ones: a guess.

    Args:
        readings: (16,) the hazards' lidar.
        given: (n, 2) hazards [m].
        position: bound on the error of a hazard's distance [m].
        bearing: bound on the error of its bearing [rad].
        radius: of the discs [m].
        out: (16, 3) receives centres and radii [m].
        source: (16,) receives n + each one's bin.

    Returns:
        How many there are.
    """
    wanted = unexplained(readings, given, position, bearing)
    return int(likeliest(readings, wanted, radius, out, source, 0, len(given)))


@entry
def goal(readings: FloatArray) -> tuple[bool, float, float]:
    """Whether the goal is within the range of its lidar (16,), and where: x ahead, y to the left [m]."""
    seen, x, y = decode_goal(readings)
    return bool(seen), float(x), float(y)
