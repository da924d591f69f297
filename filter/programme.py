"""The QPs of some robots, solved and linearised anew until their solutions are certified."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from filter import kernel
from filter.qp import Problem
from filter.solvers import Solver, solve_batch
from filter.step import Step

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class Programme:
    """The QPs of those robots of a step whose reference is refused.

    Args:
        step: the step.
        rows: (n,) which robots.
        circulating: (n,) whether the circulation row may be asked for: not of a robot that is led.

    Attributes:
        rows: (n,) those that are left.
        reference: (n, 2) of the QPs, in their variables.
        solved: (n,) whether there is a solution.
        circulates: (n,) whether it keeps the circulation row.
    """

    def __init__(self, step: Step, rows: IntArray, circulating: BoolArray) -> None:
        self.rows: IntArray = rows
        self.reference = step.reference(rows)
        self.solved = np.zeros(len(rows), np.bool_)
        self.circulates = np.zeros(len(rows), np.bool_)
        self._step = step
        self._weights = np.array([step.settings["thrust_weight"][0], 1.0])
        self._nearest = step.nearest(rows)
        self._x = self.reference
        self._circulating = circulating & (step.settings["circulation"][0] > 0.0)

    def linearise(self, trust: float) -> None:
        """Build the QPs, about the last solutions or near the backups' actions; see `kernel.linearise`."""
        step, n = self._step, len(self.rows)
        scene = step.scene
        most = int(scene.seen["count"][self.rows].max()) + 5
        self._G, self._h = np.empty((n, most, 2)), np.empty((n, most))
        self._count = np.empty(n, np.int64)
        about = self._x.copy()
        seen = (step.settings, scene.seen, scene.obstacles, self.rows)
        kernel.linearise(*seen, about, trust, self._G, self._h, self._count)
        asked = self._nearest, self.reference, self._circulating, step.memory
        kernel.add_circulation(*seen, *asked, self._G, self._h, self._count)

    def solve(self, solver: Solver) -> None:
        """Solve them: with the circulation row where there is a solution, else by the barrier rows alone."""
        about = self._x
        rows = self._count + self._circulating
        self._x, self.solved = solve_batch(solver, self._weights, self.reference, self._G, self._h, rows)
        self.circulates = self.solved & self._circulating
        again = (~self.solved & self._circulating).nonzero()[0]
        if again.size:
            part = self.reference[again], self._G[again], self._h[again], self._count[again]
            self._x[again], self.solved[again] = solve_batch(solver, self._weights, *part)
        self._x = np.where(self.solved[:, None], self._x, about)

    def action(self) -> FloatArray:
        """The solutions as actions (n, 2) u1, u2."""
        return self._x * (self._step.settings["robot"]["force_limit"][0], 1.0)

    def keep(self, which: BoolArray) -> None:
        """Go on with some of the robots."""
        self.rows, self.reference = self.rows[which], self.reference[which]
        self._x, self._nearest = self._x[which], self._nearest[which]
        self._circulating = self._circulating[which]

    def problem(self) -> Problem:
        """The first robot's QP, linearised about its reference."""
        self.linearise(trust=0.0)
        rows = self._count[0] + self._circulating[0]
        return Problem(self._weights, self.reference[0], self._G[0, :rows], self._h[0, :rows])
