"""What can be set on the filter, and the numbers in the form that compiled code takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from decision import MOST_LATE
from pointgoal.observation import HAZARD_RADIUS
from system.point_robot import ROBOT, Robot

MODEL_ERROR = 0.003
"""What the robot strays at most from the manoeuvre that was certified, from its start to its end [m]."""


@dataclass(frozen=True)
class FilterConfig:
    """Settings of the filter; the defaults are for exact sensors and the task's own robot.

    The distance kept to the edge of a hazard that is measured at d [m] is
    ``margin + position_error + d * bearing_error``, and for every metre that a backup manoeuvre still travels
    ``travel_error`` more. See docs/filter.md for how they follow from what is known of robot and sensors.

    Raises:
        ValueError: if a value is out of its range.
    """

    margin: float = 0.01
    """Kept for what the model leaves out: vase contacts, the servo's chatter between certificates [m]."""
    position_error: float = 0.0
    """Bound on the error of a hazard's measured distance [m]."""
    bearing_error: float = 0.0
    """Bound on the error of a hazard's measured bearing [rad]."""
    travel_error: float = 0.0
    """Bound on how far a backup manoeuvre strays from the model's, as a share of its way."""
    hazard_radius: float | None = None
    """Radius of every hazard [m]; None: the bundle's, or without one the task's."""
    rate: float = 0.5
    """Share of a barrier that the QP lets one control step take away, in (0, 1]; 1 brakes last."""
    keep_off: float = 0.02
    """Clearance below which a barrier row lets none of it be lost [m]: at the very margin the robot could
    not even turn, for it turns about its centre of mass."""
    hysteresis: float = 0.001
    """Clearance beyond the margin that a nominal action must leave, and a backup need not [m]."""
    thrust_weight: float = 4.0
    """Weight of a change of thrust in the QP, against 1 for a change of turn: prefer turning to braking."""
    circulation: float = 0.7
    """Share of the heading's error to the way past an obstacle that the QP's circulation row turns away in a
    control step; 0 leaves the row out."""
    pursuit: float = 0.65
    """How far along the way past an obstacle the circulation row steers the stop point to [m]."""
    slow: float = 0.1
    """A robot whose stop point is nearer than this hardly moves [m]."""
    delay_steps: int = 0
    """Control steps from an observation until the action that is decided on it takes effect, beyond the usual
    one: how old observations are and how late actions are, together. The filter predicts through the actions
    that are under way."""
    solver: str = "planar"
    """QP solver: "planar" (ours), "osqp" (kept workspace) or any that qpsolvers knows."""
    robot: Robot | None = None
    """The robot's constants; None: the bundle's, or without one the task's."""

    def __post_init__(self) -> None:
        """Refuse settings that void the guarantee."""
        errors = ("margin", "position_error", "bearing_error", "travel_error")
        for name in (*errors, "keep_off", "hysteresis"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in [0, 1), got {getattr(self, name)!r}")
        for name in ("hazard_radius", "thrust_weight", "pursuit"):
            if getattr(self, name) is not None and not 0.0 < getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in (0, 100), got {getattr(self, name)!r}")
        for name in ("circulation", "slow"):
            if not 0.0 <= getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in [0, 100), got {getattr(self, name)!r}")
        if not (isinstance(self.delay_steps, int) and 0 <= self.delay_steps <= MOST_LATE):
            raise ValueError(f"delay_steps must be 0 to {MOST_LATE}, whole, got {self.delay_steps!r}")
        if not 0.0 < self.rate <= 1.0:
            raise ValueError(f"rate must be in (0, 1], got {self.rate!r}")


_NUMBERS = (
    *("margin", "sure", "bearing_error", "position_error", "travel_error", "hazard_radius", "rate"),
    *("keep_off", "hysteresis", "thrust_weight", "circulation", "pursuit", "slow"),
)
SETTINGS = np.dtype(
    [("robot", ROBOT), ("delay_steps", "i8"), *((name, "f8") for name in _NUMBERS)], align=True
)
"""`FilterConfig`'s numbers as compiled code takes them: ``margin`` holds the position error as well, ``sure``
is what is kept whatever happens. An array of one: numba passes it fifty times as fast as a tuple."""

Settings = Any
"""One row of `SETTINGS`, in compiled code."""


def settings(config: FilterConfig) -> NDArray[np.void]:
    """The numbers of a configuration: (1,) of `SETTINGS`."""
    made = np.zeros(1, SETTINGS)
    made["robot"] = tuple(config.robot or Robot())
    made["delay_steps"] = config.delay_steps
    made["hazard_radius"] = HAZARD_RADIUS if config.hazard_radius is None else config.hazard_radius
    for name in set(_NUMBERS) - {"margin", "sure", "hazard_radius"}:
        made[name] = getattr(config, name)
    made["margin"] = config.margin + config.position_error
    made["sure"] = MODEL_ERROR + config.position_error
    return made
