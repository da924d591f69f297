"""Solvers of the QP: our own, exact in two variables; OSQP with a kept workspace; any of qpsolvers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from filter.compiled import SOURCES, compiled, entry
from filter.errors import SolverError
from filter.qp import Problem

FloatArray = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual of a solution that is accepted."""
_EPS = 1e-10

Solver = Callable[[Problem], "FloatArray | None"]
"""Takes a problem, gives its solution, or None if the solver finds it infeasible; raises SolverError."""


@compiled
def _on_line(
    normal: tuple[float, float],
    bound: float,
    G: FloatArray,
    h: FloatArray,
    rows: int,
    scale: FloatArray,
    y: FloatArray,
) -> bool:
    """Move y to the nearest point on a line that keeps the box and the first rows; False if there is none."""
    nx, ny = normal
    shift = bound - nx * y[0] - ny * y[1]
    px = y[0] + shift * nx
    py = y[1] + shift * ny
    tx, ty = -ny, nx
    low, high = -math.inf, math.inf
    for j in range(rows + 4):
        if j < 4:
            axis = j // 2
            sign = 1.0 - 2.0 * (j % 2)
            ax = sign if axis == 0 else 0.0
            ay = sign if axis == 1 else 0.0
            b = scale[axis]
        else:
            ax = G[j - 4, 0] / scale[0]
            ay = G[j - 4, 1] / scale[1]
            b = h[j - 4]
        slope = ax * tx + ay * ty
        rest = b - ax * px - ay * py
        size = math.hypot(ax, ay)
        if abs(slope) <= _EPS * size:
            if rest < -_EPS * max(size, 1.0):
                return False
        elif slope > 0.0:
            high = min(high, rest / slope)
        else:
            low = max(low, rest / slope)
    if low > high + _EPS:
        return False
    at = min(max(0.0, low), high)
    y[0] = px + at * tx
    y[1] = py + at * ty
    return True


@compiled
def solve_planar(
    weights: FloatArray, reference: FloatArray, G: FloatArray, h: FloatArray, rows: int, x: FloatArray
) -> bool:
    """Solve one QP exactly, constraint by constraint.

    In the variables y = sqrt(P) x the QP asks for the point nearest to the reference. The rows are taken in
    turn: if the best point so far breaks the next, the new best point lies on that row's line (Seidel 1991,
        "Small-dimensional
    linear programming and convex hulls made easy"; it holds for every LP-type problem).

    Args:
        weights: (2,) diagonal of P.
        reference: (2,).
        G: (>= rows, 2).
        h: (>= rows,).
        rows: how many rows there are.
        x: (2,) receives the solution.

    Returns:
        Whether the problem is feasible.
    """
    scale = np.sqrt(weights)
    y = np.empty(2)
    # The box alone is met by clipping, so the search starts with its best point.
    for axis in range(2):
        y[axis] = min(max(reference[axis], -1.0), 1.0) * scale[axis]
    wanted = reference * scale
    for i in range(rows):
        ax = G[i, 0] / scale[0]
        ay = G[i, 1] / scale[1]
        size = math.hypot(ax, ay)
        if ax * y[0] + ay * y[1] <= h[i] + _EPS * max(size, 1.0):
            continue
        if size < 1e-14:
            return False
        y[0] = wanted[0]
        y[1] = wanted[1]
        if not _on_line((ax / size, ay / size), h[i] / size, G, h, i, scale, y):
            return False
    x[0] = min(max(y[0] / scale[0], -1.0), 1.0)
    x[1] = min(max(y[1] / scale[1], -1.0), 1.0)
    return True


def _solve_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def solve_batch(
        weights: FloatArray,
        reference: FloatArray,
        G: FloatArray,
        h: FloatArray,
        rows: NDArray[np.int64],
        x: FloatArray,
        solved: NDArray[np.bool_],
    ) -> None:
        """Solve N problems: (N, 2), (N, M, 2), (N, M), (N,) -> (N, 2), (N,). Negative rows: skipped."""
        if not sources:
            return
        for k in range(rows.size):
            solved[k] = rows[k] >= 0 and solve_planar(weights, reference[k], G[k], h[k], rows[k], x[k])

    return solve_batch


solve_batch = _solve_entry()


def planar(problem: Problem) -> FloatArray | None:
    """Solve one problem with `solve_planar`."""
    x = np.empty((1, 2))
    solved = np.zeros(1, dtype=bool)
    rows = np.array([problem.h.size])
    solve_batch(problem.weights, problem.reference[None], problem.G[None], problem.h[None], rows, x, solved)
    return x[0] if solved[0] else None


def through_qpsolvers(name: str) -> Solver:
    """A solver of qpsolvers by its name, for example "daqp", "quadprog" or "piqp".

    Raises:
        ValueError: if qpsolvers has no such solver installed.
    """
    import qpsolvers

    if name not in qpsolvers.available_solvers:
        known = ", ".join(["planar", "osqp", *sorted(qpsolvers.available_solvers)])
        raise ValueError(f"no QP solver {name!r}; installed are: {known}")
    low, high = np.full(2, -1.0), np.full(2, 1.0)
    box = np.vstack([np.eye(2), -np.eye(2)])

    def solve(problem: Problem) -> FloatArray | None:
        # Rows of length 1 keep the solvers' absolute tolerances meaningful; the box goes in as rows for the
        # solvers that know no other form.
        length = np.maximum(np.linalg.norm(problem.G, axis=1), 1e-9)
        G = np.vstack([problem.G / length[:, None], box])
        h = np.concatenate([problem.h / length, high, -low])
        try:
            x = qpsolvers.solve_qp(
                np.diag(problem.weights), -problem.weights * problem.reference, G, h, solver=name
            )
        except qpsolvers.SolverError as error:
            raise SolverError(problem, f"{name}: {error}") from error
        return None if x is None else np.asarray(x, dtype=np.float64)

    return solve


def make_solver(name: str) -> Solver:
    """The solver of a name.

    Raises:
        ValueError: if there is no such solver.
    """
    if name == "planar":
        return planar
    return through_qpsolvers(name)
