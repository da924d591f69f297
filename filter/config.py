"""What can be set on the filter, and the numbers in the form that compiled code takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from filter.robot import Robot
from pointgoal.observation import HAZARD_RADIUS

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
    hazard_radius: float = HAZARD_RADIUS
    """Radius of every hazard [m]."""
    rate: float = 0.5
    """Share of a barrier that the QP lets one control step take away, in (0, 1]; 1 brakes last."""
    keep_off: float = 0.005
    """Clearance that the QP drives back to [m]: at the very margin the robot could not even turn."""
    hysteresis: float = 0.001
    """Clearance beyond the margin that a nominal action must leave, and a backup need not [m]."""
    thrust_weight: float = 4.0
    """Weight of a change of thrust in the QP, against 1 for a change of turn: prefer turning to braking."""
    lookahead: float = 1.2
    """A hazard nearer than this on the straight way to the goal is driven round [m]; 0 turns that off."""
    clearance: float = 0.06
    """Distance that the way round keeps from what the certificate asks for [m]."""
    pursuit: float = 0.65
    """How far ahead of the robot, along the way round, the stop point is steered to [m]."""
    eagerness: float = 1.5
    """Thrust on the way round, per cosine of the heading's error."""
    repulsion: float = 4.0
    """How strongly the way round leads away from a hazard that is nearer than ``clearance``."""
    steadiness: float = 0.5
    """Length by which the other way round must be shorter before the robot changes its mind [m]."""
    slow: float = 0.1
    """A robot whose stop point is nearer than this [m] and whose nominal action is refused is led on."""
    solver: str = "planar"
    """QP solver: "planar" (ours), "osqp" (kept workspace) or any that qpsolvers knows."""
    robot: Robot = field(default_factory=Robot)
    """The robot's constants."""

    def __post_init__(self) -> None:
        """Refuse settings that void the guarantee."""
        errors = ("margin", "position_error", "bearing_error", "travel_error")
        shares = (*errors, "keep_off", "hysteresis")
        for name in shares:
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in [0, 1), got {getattr(self, name)!r}")
        positive = ("hazard_radius", "thrust_weight", "clearance", "pursuit", "eagerness")
        for name in positive:
            if not 0.0 < getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in (0, 100), got {getattr(self, name)!r}")
        for name in ("lookahead", "repulsion", "steadiness", "slow"):
            if not 0.0 <= getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in [0, 100), got {getattr(self, name)!r}")
        if not 0.0 < self.rate <= 1.0:
            raise ValueError(f"rate must be in (0, 1], got {self.rate!r}")


class Settings(NamedTuple):
    """`FilterConfig`'s numbers as compiled code takes them; ``margin`` holds the position error as well."""

    robot: Robot
    margin: float
    sure: float
    bearing_error: float
    travel_error: float
    hazard_radius: float
    rate: float
    keep_off: float
    hysteresis: float
    thrust_weight: float
    lookahead: float
    clearance: float
    pursuit: float
    eagerness: float
    repulsion: float
    steadiness: float
    slow: float


def settings(config: FilterConfig) -> Settings:
    """The numbers of a configuration."""
    names = [name for name in Settings._fields if name not in ("robot", "margin", "sure")]
    numbers = {name: float(getattr(config, name)) for name in names}
    return Settings(
        robot=config.robot,
        margin=config.margin + config.position_error,
        sure=MODEL_ERROR + config.position_error,
        **numbers,
    )
