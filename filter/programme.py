"""The QP of one robot, written down for any solver, and linearised anew until its solution is certified."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from filter import kernel
from filter.qp import Problem
from filter.solvers import Solver, solve
from filter.step import Step

FloatArray = NDArray[np.float64]


class Programme:
    """The QP of a robot whose reference is refused; `kernel.settle` is the same in one go, by our solver.

    Args:
        step: the step.
        k: which robot.
        circulating: whether the circulation row is asked for: not of a robot that is led.
    """

    def __init__(self, step: Step, k: int, circulating: bool) -> None:
        self._step = step
        self._k = k
        self._circulating = circulating and bool(step.settings["circulation"][0] > 0.0)
        self._largest = np.array([step.settings["robot"]["force_limit"][0], 1.0])
        self._weights = np.array([step.settings["thrust_weight"][0], 1.0])
        self._nearest = max(int(step.certificates["nearest"][k]), 0)
        self._reference = np.clip(step.action[k] / self._largest, -1.0, 1.0)
        self._x = self._reference

    def problem(self, trust: float) -> Problem:
        """The QP, the circulation row last; ``trust`` as in `kernel.write_problem`."""
        step, most = self._step, self._step.scene.obstacles.shape[1] + 5
        G, h, about = np.empty((most, 2)), np.empty(most), self._x.copy()
        seen = step.settings, step.scene.seen, step.scene.obstacles, self._k, self._nearest, trust
        asked = self._circulating
        rows = asked + kernel.write_problem(*seen, self._reference, asked, step.memory, about, G, h)
        return Problem(self._weights, self._reference, G[:rows], h[:rows])

    def run(self, solver: Solver) -> tuple[int, FloatArray]:
        """What `kernel.settle` would say of it, and the action (2,) u1, u2."""
        for trust in kernel.LINEARISATIONS:
            problem = self.problem(trust)
            found, circled = solve(solver, problem), self._circulating
            if found is None and circled:
                rows, circled = len(problem.h) - 1, False
                found = solve(
                    solver, Problem(self._weights, self._reference, problem.G[:rows], problem.h[:rows])
                )
            if found is None:
                continue
            self._x, action = found, found * self._largest
            if self._step.certify(self._k, action):
                return kernel.CIRCULATION if circled else kernel.BARRIER, action
        return kernel.OPEN, self._step.action[self._k]
