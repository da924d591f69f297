"""The safety filter: the robot's dynamics, obstacles, barrier, QP, certificate and backup manoeuvres."""

from filter.barrier_filter import (
    SAFE_ACTION,
    BarrierFilter,
    FilterMemory,
    FilterResult,
    Mode,
    Row,
    committed_backup,
)
from filter.config import FilterConfig
from filter.errors import FilterError, FilterInputError, SolverError

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
    "SolverError",
    "committed_backup",
]
