"""What can be set on the filter, and the numbers in the form that compiled code takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from filter.robot import Robot
from pointgoal.observation import HAZARD_RADIUS


@dataclass(frozen=True)
class FilterConfig:
    """Settings of the filter; the defaults are for exact sensors and the task's own robot.

    The margin that is kept to a hazard at distance d [m] is ``margin + position_error + d * bearing_error``, and
    for every metre that a backup manoeuvre still travels ``travel_error`` more.
    """

    margin: float = 0.01
    """Distance kept to a hazard's edge for what the model leaves out: vase contacts, the servo's chatter [m]."""
    position_error: float = 0.0
    """Bound on the error of a hazard's measured distance [m]."""
    bearing_error: float = 0.0
    """Bound on the error of a hazard's measured bearing [rad]."""
    travel_error: float = 0.0
    """Bound on how far a backup manoeuvre strays from the model's, per metre of its way (docs/filter.md) [1]."""
    hazard_radius: float = HAZARD_RADIUS
    """Radius of every hazard [m]."""
    rate: float = 0.5
    """Share of the barrier that the QP lets one control step take away, in (0, 1]; 1 brakes last."""
    thrust_weight: float = 4.0
    """Weight of a change of thrust in the QP, against 1 for a change of turn: prefer turning to braking."""
    lookahead: float = 1.2
    """A hazard nearer than this on the straight way to the goal is driven round; 0 turns that off [m]."""
    clearance: float = 0.06
    """Distance that the way round keeps from what the certificate asks for [m]."""
    repulsion: float = 4.0
    eager: float = 2.0
    keep_off: float = 0.005
    hysteresis: float = 0.001
    mind: float = 0.5
    slow: float = 0.1
    pursuit: float = 0.8
    """Least distance of the point that the way round steers at [m]."""
    solver: str = "planar"
    """QP solver: "planar" (ours, two variables, compiled), "osqp" (kept workspace) or any that qpsolvers knows."""
    robot: Robot = field(default_factory=Robot)
    """The robot's constants."""

    def __post_init__(self) -> None:
        """Refuse settings that void the guarantee.

        Raises:
            ValueError: if a value is out of its range.
        """
        for name in ("margin", "position_error", "bearing_error", "travel_error"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in [0, 1), got {getattr(self, name)!r}")
        if not self.hazard_radius > 0.0:
            raise ValueError(f"hazard_radius must be positive, got {self.hazard_radius!r}")
        if not 0.0 < self.rate <= 1.0:
            raise ValueError(f"rate must be in (0, 1], got {self.rate!r}")
        if not 0.0 < self.thrust_weight:
            raise ValueError(f"thrust_weight must be positive, got {self.thrust_weight!r}")


class Settings(NamedTuple):
    """`FilterConfig`'s numbers as compiled code takes them."""

    robot: Robot
    margin: float
    bearing_error: float
    travel_error: float
    hazard_radius: float
    rate: float
    thrust_weight: float
    lookahead: float
    clearance: float
    pursuit: float
    repulsion: float
    eager: float
    keep_off: float
    hysteresis: float
    mind: float
    slow: float


def settings(config: FilterConfig) -> Settings:
    """The numbers of a configuration."""
    return Settings(
        robot=config.robot,
        margin=config.margin + config.position_error,
        bearing_error=config.bearing_error,
        travel_error=config.travel_error,
        hazard_radius=config.hazard_radius,
        rate=config.rate,
        thrust_weight=config.thrust_weight,
        lookahead=config.lookahead,
        clearance=config.clearance,
        pursuit=config.pursuit,
        repulsion=config.repulsion,
        eager=config.eager,
        keep_off=config.keep_off,
        hysteresis=config.hysteresis,
        mind=config.mind,
        slow=config.slow,
    )
