"""The safety filter: the robot's dynamics, obstacles, barrier, QP, certificate and backup manoeuvres."""

from filter.barrier_filter import BarrierFilter, committed_backup
from filter.config import FilterConfig
from filter.errors import FilterError, FilterInputError, SolverError
from filter.result import SAFE_ACTION, FilterMemory, FilterResult, Mode, Row
from filter.wrapper import SafetyFilter

__all__ = [
    "SAFE_ACTION",
    "BarrierFilter",
    "FilterConfig",
    "FilterError",
    "FilterInputError",
    "FilterMemory",
    "FilterResult",
    "Mode",
    "Row",
    "SafetyFilter",
    "SolverError",
    "committed_backup",
]
