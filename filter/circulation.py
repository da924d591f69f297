"""The circulation row: along an obstacle instead of against it.

A robot that a policy keeps pushing straight at an obstacle would stand in front of it for ever, since a
barrier row only takes its thrust away. The circulation row of the same QP turns it meanwhile: the heading's
error from the way past the obstacle has to fall by a share in every control step (a circulation inequality,
Gonçalves et al. 2024, in the heading, the input of relative degree one here). The side is the one that needs
the smaller turn, that the policy turns to, and that was chosen before, from obstacle to obstacle, so that the
robot follows the outline of what stands together. As soon as thrust no longer leads into the obstacle, the
barrier rows give it back.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from filter.config import Settings
from system.backups import steered
from system.compiled import compiled
from system.point_robot import State, Stopping, stopping

FloatArray = NDArray[np.float64]

SIDE_STEPS = 50
"""Control steps for which a side is remembered after the last refusal: 1 s."""
_STEADY = 0.5
"""Turn that it has to save to change the side [rad]."""
_TURN = 1.0
"""Turn [rad] that the side to which the policy turns, at full rate, is favoured by."""


@compiled
def way_past(obstacle: FloatArray, side: int) -> tuple[float, float]:
    """Unit vector from the origin past an obstacle on a side: 1 to its left, -1 to its right."""
    # Of a cone, the place on its axis that is nearest to the robot.
    x, y, dx, dy = obstacle[0], obstacle[1], obstacle[2], obstacle[3]
    square = dx * dx + dy * dy
    at = min(max(-(x * dx + y * dy) / square, 0.0), 1.0) if square > 0.0 else 0.0
    x += at * dx
    y += at * dy
    distance = max(math.hypot(x, y), 1e-9)
    sine = min((obstacle[4] + at * obstacle[5]) / distance, 1.0)
    cosine = math.sqrt(1.0 - sine * sine)
    sine *= side
    return (cosine * x - sine * y) / distance, (sine * x + cosine * y) / distance


@compiled
def _error(settings: Settings, obstacle: FloatArray, now: Stopping, end: float, side: int) -> float:
    """Angle from the end that leads to the way past an obstacle on a side [rad]."""
    x, y = way_past(obstacle, side)
    x = end * (settings.pursuit * x - now.zx)
    y = end * (settings.pursuit * y - now.zy)
    return math.atan2(y, x)


@compiled
def circulate(
    settings: Settings, obstacle: FloatArray, state: State, reference: FloatArray, side: int
) -> tuple[int, float]:
    """The side on which to pass an obstacle, and the turn that the circulation row asks for.

    Args:
        settings: the filter's numbers.
        obstacle: (COLUMNS,) the one that the reference would run into.
        state: the measured state.
        reference: (2,) of the QP: the sign of its thrust tells which end leads.
        side: the one chosen before: 1 left, -1 right, 0 none.

    Returns:
        The side, and the turn in [-1, 1]: the QP's has to be at least as far to that side of 0.
    """
    now = stopping(settings.robot, state)
    end = -1.0 if reference[0] < 0.0 else 1.0
    left = _error(settings, obstacle, now, end, 1)
    right = _error(settings, obstacle, now, end, -1)
    # The side to which the robot has to turn less, to which the policy turns, and that was chosen before.
    score = abs(right) - abs(left) + _STEADY * side
    turning = reference[1]
    score += _TURN * turning * (0.5 if left > 0.0 else -0.5)
    score -= _TURN * turning * (0.5 if right > 0.0 else -0.5)
    side = 1 if score >= 0.0 else -1
    error = left if side > 0 else right
    return side, steered(settings.robot, settings.circulation * error)
