"""What the filter gives back, and what it remembers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from filter import kernel

FloatArray = NDArray[np.float64]

SAFE_ACTION = (0.0, 0.0)
"""Zero thrust, no turn: what to send when nothing is known."""


class Mode(IntEnum):
    """What became of the nominal action."""

    NOMINAL = kernel.NOMINAL
    """It passed, bit for bit."""
    FILTERED = kernel.FILTERED
    """Another action was certified in its place."""
    FALLBACK = kernel.FALLBACK
    """Nothing is certified: the committed backup, or the way out of a hazard."""


class Row(IntEnum):
    """What an intervention came from."""

    NONE = kernel.NO_ROW
    """There was none."""
    BARRIER = kernel.BARRIER_ROW
    """A barrier row of the QP: the reference would have let a clearance fall too fast."""
    DETOUR = kernel.DETOUR_ROW
    """A hazard is in the straight way to the goal: the action drives round it."""
    SEARCH = kernel.SEARCH_ROW
    """The QP had no solution or that had no certificate; the nearest certified action was sent."""
    BACKUP = kernel.BACKUP_ROW
    """No action had a certificate; the least harmful manoeuvre was sent."""


REASONS = (
    None,
    "no certified action: committed backup",
    "inside a hazard: driving out",
    "too fast to stay clear of a hazard: least harm",
)
"""The reasons of a fallback."""


@dataclass(frozen=True)
class FilterMemory:
    """What a robot's filter remembers from step to step. It may be left out.

    Attributes:
        side: (N,) int8, the side on which the robot passes what is in its way: 1 left, -1 right, 0 none.
        plan: (N,) int8, the backup that the last action's certificate ends in, and its steps of thrust:
            1 + backup + 3 * steps; 0 is none.
    """

    side: NDArray[np.int8]
    plan: NDArray[np.int8]

    @staticmethod
    def empty(n: int) -> FilterMemory:
        """The memory of n robots before their first step."""
        return FilterMemory(np.zeros(n, dtype=np.int8), np.zeros(n, dtype=np.int8))


@dataclass(frozen=True)
class FilterResult:
    """What the filter decided, for N robots.

    Attributes:
        action: (N, 2) what to send.
        mode: (N,) int8, see `Mode`.
        barrier: (N,) clearance [m] beyond the margin that the best backup keeps from the present state;
            below 0 no backup keeps the margin. At most the lidar's range.
        hazard: (N,) index of the hazard (given hazards) or of the lidar's bin that the intervention came
            from; -1: there was no intervention.
        row: (N,) int8, see `Row`.
        reason: N texts, one for each fallback, else None.
        memory: to pass to the next call.
    """

    action: FloatArray
    mode: NDArray[np.int8]
    barrier: FloatArray
    hazard: NDArray[np.int64]
    row: NDArray[np.int8]
    reason: list[str | None]
    memory: FilterMemory

    @staticmethod
    def concatenate(parts: list[FilterResult]) -> FilterResult:
        """The results of several groups of robots as one, in order."""
        if len(parts) == 1:
            return parts[0]
        return FilterResult(
            action=np.concatenate([part.action for part in parts]),
            mode=np.concatenate([part.mode for part in parts]),
            barrier=np.concatenate([part.barrier for part in parts]),
            hazard=np.concatenate([part.hazard for part in parts]),
            row=np.concatenate([part.row for part in parts]),
            reason=[reason for part in parts for reason in part.reason],
            memory=FilterMemory(
                side=np.concatenate([part.memory.side for part in parts]),
                plan=np.concatenate([part.memory.plan for part in parts]),
            ),
        )
