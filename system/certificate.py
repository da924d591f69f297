"""The certificate of an action: an exact step of the model, the path within it, and a backup from its end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from system.clearance import Settings, best_backup
from system.compiled import compiled
from system.obstacles import FAR, least_gap
from system.point_robot import State, advance, stopping

FloatArray = NDArray[np.float64]

CERTIFICATE = np.dtype(
    [("clearance", "f8"), ("nearest", "i8"), ("backup", "i8"), ("steps", "i8")], align=True
)
"""What a certificate says: the clearance [m], at or above 0 if there is one; the obstacle that bounds it, -1
if none; the backup that it ends in, and for how many control steps that one thrusts."""


@compiled
def certify(
    settings: Settings,
    obstacles: FloatArray,
    count: int,
    state: State,
    thrust: float,
    turn: float,
    enough: float,
) -> tuple[float, int, int, int]:
    """How far the robot surely stays from every obstacle if it takes an action now and a backup afterwards.

    ``thrust`` and ``turn`` are u1 and u2; a clearance of ``enough`` [m] is not looked beyond: 0 asks only
    whether the action is certified.

    Returns:
        The clearance [m], at or above 0 if the action is certified; the obstacle that bounds it; the backup;
        its steps of thrust.
    """
    half = settings.robot.substeps // 2
    middle = advance(settings.robot, state, thrust, turn, half)
    after = advance(settings.robot, middle, thrust, turn, settings.robot.substeps - half)
    value, blocker, kind, steps = best_backup(
        settings, obstacles, count, stopping(settings.robot, after), enough, False
    )
    first, at_first = least_gap(obstacles, count, state.x, state.y, middle.x, middle.y, blocker, -FAR)
    second, at_second = least_gap(obstacles, count, middle.x, middle.y, after.x, after.y, blocker, -FAR)
    if min(first, second) < value:
        value = min(first, second)
        blocker = at_first if first < second else at_second
    return value, blocker, kind, steps
