"""The floor of the gate: how low a barrier may be before the filter has to look at every action."""

from __future__ import annotations

from filter.config import FilterConfig
from system.point_robot import Robot


def floor(config: FilterConfig) -> float:
    """The barrier [m] from which no single action leads below 0.

    In one control step thrust moves the stop point by at most V dt, V the speed at which full thrust moves
    it. The best backup might have moved it as far the other way, so a nominal action costs at most 2 V dt of
    the clearance that this backup would have kept; a backup whose way is allowed ``travel_error`` a metre
    loses that share more. For the point robot that is 6 cm. What a turn costs beyond it is not in this
    argument: docs/filter.md says what a search for the worst state found, and a test checks it.
    """
    robot = config.robot or Robot()
    return 2.0 * robot.stop_speed * robot.control_step * (1.0 + config.travel_error)
