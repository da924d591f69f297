"""The filter's errors: one hierarchy, whose members carry what failed."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filter.qp import Problem


class FilterError(Exception):
    """Base of the errors that the filter raises."""


class FilterInputError(FilterError, ValueError):
    """An input, ``field``, has a wrong shape or value; the caller decides what the robot does then."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field


class SolverError(FilterError):
    """A QP solver broke down (not: found the problem infeasible).

    Attributes:
        problem: the QP that was to be solved.
    """

    def __init__(self, problem: Problem, message: str) -> None:
        super().__init__(message)
        self.problem = problem
