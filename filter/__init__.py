"""The safety filter: the robot's dynamics, obstacles, barrier, QP, certificate and backup manoeuvres."""

from filter.barrier_filter import BarrierFilter
from filter.config import FilterConfig
from filter.errors import FilterError, FilterInputError, SolverError
from filter.scene import DOUBT, Scene
from filter.step import Led, Step
from filter.wrapper import SafetyFilter
from system.point_robot import Robot

__all__ = [
    "DOUBT",
    "BarrierFilter",
    "FilterConfig",
    "FilterError",
    "FilterInputError",
    "Led",
    "Robot",
    "SafetyFilter",
    "Scene",
    "SolverError",
    "Step",
]
