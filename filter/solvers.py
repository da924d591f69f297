"""Solvers of the QP: our own, exact in two variables; OSQP with a kept workspace; any of qpsolvers."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter.errors import SolverError
from filter.qp import Problem
from system.compiled import compiled, entry

FloatArray = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual of a solution that is accepted."""
_EPS = 1e-10
_LEAST_ROWS = 8
"""Rows of the smallest workspace of OSQP."""
_BOX = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
_OPTIONS: dict[str, dict[str, Any]] = {
    "piqp": {"eps_abs": 1e-10, "eps_rel": 1e-10},
    "proxqp": {"eps_abs": 1e-10, "eps_rel": 0.0},
    "clarabel": {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11},
}
"""Accuracies beyond the solvers' own defaults."""

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
    "Small-dimensional linear programming and convex hulls made easy"; it holds for every LP-type problem).
    ``weights`` (2,) is P's diagonal; of ``G`` (m, 2) and ``h`` (m,) the first ``rows`` count; ``x`` (2,)
    receives the solution.

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


@entry
def _solve(weights: FloatArray, reference: FloatArray, G: FloatArray, h: FloatArray, x: FloatArray) -> bool:
    """`solve_planar` with all of the rows."""
    return bool(solve_planar(weights, reference, G, h, len(h), x))


def planar(problem: Problem) -> FloatArray | None:
    """Solve one problem with `solve_planar`."""
    x = np.empty(2)
    return x if _solve(problem.weights, problem.reference, problem.G, problem.h, x) else None


class KeptOSQP:
    """OSQP with kept workspaces: one a size, set up once and only updated afterwards.

    Args:
        eps: absolute and relative tolerance; OSQP's own 1e-3 lets limits drift.
    """

    def __init__(self, eps: float = 1e-8) -> None:
        self._eps = eps
        # A workspace is written to and solved in two calls: threads must not share one.
        self._own = threading.local()

    def __reduce__(self) -> tuple[type[KeptOSQP], tuple[float]]:
        return KeptOSQP, (self._eps,)

    def __call__(self, problem: Problem) -> FloatArray | None:
        """Solve one problem, or raise SolverError if OSQP finds neither a solution nor infeasibility."""
        import osqp

        G, h = problem.scaled()
        size = _LEAST_ROWS
        while size < h.size:
            size *= 2
        # Rows that are left over ask for nothing: they are zero, with a bound above it.
        A = np.zeros((size + 2, 2))
        A[: h.size] = G
        A[size:] = np.eye(2)
        upper = np.ones(size + 2)
        upper[: h.size] = h
        lower = np.full(size + 2, -np.inf)
        lower[size:] = -1.0
        workspace = self._workspace(size, problem.weights)
        workspace.update(q=-problem.weights * problem.reference, l=lower, u=upper, Ax=A.T.ravel())
        result = workspace.solve(raise_error=False)
        if result.info.status_val in (
            osqp.SolverStatus.OSQP_SOLVED,
            osqp.SolverStatus.OSQP_SOLVED_INACCURATE,
        ):
            return np.asarray(result.x, dtype=np.float64)
        if result.info.status_val in (
            osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE,
            osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE,
        ):
            return None
        raise SolverError(problem, f"osqp: {result.info.status}")

    def _workspace(self, size: int, weights: FloatArray) -> Any:
        """The workspace for so many rows: P and the places of A are fixed, all else is updated."""
        import osqp
        from scipy import sparse

        key = (size, float(weights[0]), float(weights[1]))
        workspaces: dict[Any, Any] = self._own.__dict__.setdefault("workspaces", {})
        if key not in workspaces:
            rows = np.tile(np.arange(size + 2), 2)
            columns = np.repeat([0, 1], size + 2)
            A = sparse.csc_matrix((np.ones(2 * size + 4), (rows, columns)), shape=(size + 2, 2))
            workspace = osqp.OSQP()
            workspace.setup(
                P=sparse.csc_matrix(np.diag(weights)),
                q=np.zeros(2),
                A=A,
                l=np.full(size + 2, -np.inf),
                u=np.ones(size + 2),
                eps_abs=self._eps,
                eps_rel=self._eps,
                eps_prim_inf=self._eps,
                max_iter=20_000,
                verbose=False,
            )
            workspaces[key] = workspace
        return workspaces[key]


class ByQpsolvers:
    """A solver of qpsolvers by its name, for example "daqp"; ValueError if it is not installed."""

    def __init__(self, name: str) -> None:
        import qpsolvers

        if name not in qpsolvers.available_solvers:
            known = ", ".join(["planar", "osqp", *sorted(qpsolvers.available_solvers)])
            raise ValueError(f"no QP solver {name!r}; there are: {known}")
        self._name = name

    def __call__(self, problem: Problem) -> FloatArray | None:
        """Solve one problem, or raise SolverError if the solver breaks down."""
        import qpsolvers

        G, h = problem.scaled()
        P, q = np.diag(problem.weights), -problem.weights * problem.reference
        # The box goes in as rows, the one form that every solver takes; an exact box is clipped afterwards.
        rows, bounds = np.vstack([G, _BOX]), np.concatenate([h, np.ones(4)])
        try:
            x = qpsolvers.solve_qp(P, q, rows, bounds, solver=self._name, **_OPTIONS.get(self._name, {}))
        except qpsolvers.SolverError as error:
            raise SolverError(problem, f"{self._name}: {error}") from error
        return None if x is None else np.asarray(x, dtype=np.float64)


def make_solver(name: str) -> Solver:
    """The solver of a name: "planar", "osqp" or one of qpsolvers'; ValueError if there is none."""
    if name == "planar":
        return planar
    if name == "osqp":
        return KeptOSQP()
    return ByQpsolvers(name)


def solve(solver: Solver, problem: Problem) -> FloatArray | None:
    """A solution that keeps all rows; None if the solver has none, or breaks down.

    A solver's word is not enough: a solution that breaks a row counts as none.
    """
    try:
        found = solver(problem)
    except SolverError:
        return None  # the next linearisation, or the search, does without
    if found is None or not problem.residual(found) <= TOLERANCE:
        return None
    return np.clip(found, -1.0, 1.0)
