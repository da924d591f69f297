"""The filter: nominal action in, certified action out. A batch at a time; one robot is a batch of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter.config import FilterConfig, settings
from filter.errors import FilterInputError, SolverError
from filter.kernel import MOST_PLAN, PASSES, PLAN, SIDE, finish, prepare
from filter.lidar import CONES
from filter.obstacles import COLUMNS
from filter.qp import Problem
from filter.result import REASONS, FilterMemory, FilterResult
from filter.solvers import TOLERANCE, Solver, make_solver, solve_batch
from pointgoal.observation import ObservationLayout, layout

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_CHUNK = 512
"""Robots handled at once: bounds the memory of the obstacles."""


@dataclass(frozen=True)
class _Columns:
    """Where an observation of one size has what the filter reads.

    Attributes:
        motion: velocity ahead, velocity to the left, yaw rate.
        goal: the goal's lidar.
        hazards: the hazards' lidar; empty at level 0, which has none.
    """

    motion: list[int]
    goal: slice
    hazards: slice

    @staticmethod
    def of(where: ObservationLayout) -> _Columns:
        velocity = where.slice("velocimeter").start
        hazards = where.slice("hazards_lidar") if "hazards_lidar" in where else slice(0, 0)
        return _Columns(
            [velocity, velocity + 1, where.slice("gyro").stop - 1], where.slice("goal_lidar"), hazards
        )


_COLUMNS = {where.size: _Columns.of(where) for where in (layout(0), layout(1))}


@dataclass(frozen=True)
class _Work:
    """What passes from the building of n robots' QPs to their repair; see `kernel.prepare`."""

    states: FloatArray
    readings: FloatArray
    obstacles: FloatArray
    source: IntArray
    count: IntArray
    barrier: FloatArray
    hazard: IntArray
    reference: FloatArray
    G: FloatArray
    h: FloatArray
    rows: IntArray


class BarrierFilter:
    """Turns nominal actions into certified ones.

    It keeps nothing between calls: what a robot's filter remembers is passed in and out, so one filter
    serves any number of robots, and a batch of N gives what N single calls give.

    Raises:
        ValueError: if the configuration names a solver that is not installed.
    """

    def __init__(self, config: FilterConfig | None = None) -> None:
        self.config = FilterConfig() if config is None else config
        self._settings = settings(self.config)
        self._weights = np.array([self.config.thrust_weight, 1.0])
        self._solver: Solver | None = None
        if self.config.solver != "planar":
            self._solver = make_solver(self.config.solver)

    def filter(
        self,
        observation: ArrayLike,
        nominal_action: ArrayLike,
        hazards: ArrayLike | None = None,
        memory: FilterMemory | None = None,
        active: ArrayLike | None = None,
    ) -> FilterResult:
        """Filter N actions.

        Args:
            observation: (N, 60), or (N, 28) at level 0.
            nominal_action: (N, 2), clipped to ±1.
            hazards: (N, n, 2) centres in the body frame, x ahead and y to the left [m]; rows of NaN are
                absent ones. None: decode them from the lidar.
            memory: what the last call returned, or None.
            active: (N,) where False, the nominal action passes as it is. None: all True.

        Returns:
            The actions and what led to them.

        Raises:
            FilterInputError: if an input has a wrong shape or a value that is not finite.
        """
        seen, nominal = _check_inputs(observation, nominal_action)
        n = len(seen)
        given = None if hazards is None else _check_hazards(hazards, n)
        gate = np.ones(n, dtype=np.bool_) if active is None else _check_active(active, n)
        past = np.zeros((n, 2), dtype=np.int8) if memory is None else _check_memory(memory, n)
        parts = []
        for start in range(0, max(n, 1), _CHUNK):
            part = slice(start, start + _CHUNK)
            hazards_part = None if given is None else given[part]
            parts.append(self._filter(seen[part], nominal[part], hazards_part, gate[part], past[part]))
        return FilterResult.concatenate(parts)

    def problem(
        self, observation: ArrayLike, nominal_action: ArrayLike, hazards: ArrayLike | None = None
    ) -> Problem | None:
        """The QP of one robot.

        Args:
            observation: (60,) or (28,).
            nominal_action: (2,).
            hazards: (n, 2) in the body frame [m], or None.

        Returns:
            The QP; None where none is solved: the nominal action passes, or the detour's is certified as it
            is.

        Raises:
            FilterInputError: if an input has a wrong shape or a value that is not finite.
        """
        seen, nominal = _check_inputs(np.asarray(observation)[None], np.asarray(nominal_action)[None])
        given = None if hazards is None else _check_hazards(np.asarray(hazards)[None], 1)
        past = np.zeros((1, 2), dtype=np.int8)
        work = self._prepare(seen, nominal, given, np.ones(1, dtype=np.bool_), past)
        return self._problem(work, 0) if work.rows[0] >= 0 else None

    def _prepare(
        self,
        seen: FloatArray,
        nominal: FloatArray,
        given: FloatArray | None,
        active: BoolArray,
        memory: NDArray[np.int8],
    ) -> _Work:
        """Build the QPs of n robots; the memory (n, 2) is overwritten."""
        n, width = seen.shape
        columns = _COLUMNS[width]
        hazards = columns.hazards if given is None else slice(0, 0)
        if given is None:
            given = np.empty((n, 0, 2))
        size = given.shape[1] if hazards.stop == 0 else CONES
        states, readings = seen[:, columns.motion], np.ascontiguousarray(seen[:, hazards])
        work = _Work(
            states=states,
            readings=readings,
            obstacles=np.empty((n, size, COLUMNS)),
            source=np.empty((n, size), dtype=np.int64),
            count=np.empty(n, dtype=np.int64),
            barrier=np.empty(n),
            hazard=np.empty(n, dtype=np.int64),
            reference=np.empty((n, 2)),
            G=np.empty((n, size, 2)),
            h=np.empty((n, size)),
            rows=np.empty(n, dtype=np.int64),
        )
        prepare(
            self._settings,
            states,
            given,
            readings,
            np.ascontiguousarray(seen[:, columns.goal]),
            nominal,
            active,
            memory,
            work.obstacles,
            work.source,
            work.count,
            work.barrier,
            work.hazard,
            work.reference,
            work.G,
            work.h,
            work.rows,
        )
        return work

    def _problem(self, work: _Work, k: int) -> Problem:
        rows = work.rows[k]
        return Problem(self._weights, work.reference[k], work.G[k, :rows], work.h[k, :rows])

    def _solve(self, work: _Work) -> tuple[FloatArray, BoolArray]:
        """Solve the QPs: (n, 2) solutions, the reference where there is none; (n,) where there is one."""
        solution = work.reference.copy()
        solved = np.zeros(len(solution), dtype=np.bool_)
        if self._solver is None:
            solve_batch(self._weights, work.reference, work.G, work.h, work.rows, solution, solved)
            return solution, solved
        for k in np.flatnonzero(work.rows >= 0):
            problem = self._problem(work, int(k))
            try:
                x = self._solver(problem)
            except SolverError:
                continue  # the repair finds a certified action without a solution
            # A solver's word is not enough: a solution that breaks a row counts as none.
            if x is not None and problem.residual(x) <= TOLERANCE:
                solution[k], solved[k] = np.clip(x, -1.0, 1.0), True
        return solution, solved

    def _filter(
        self,
        seen: FloatArray,
        nominal: FloatArray,
        given: FloatArray | None,
        active: BoolArray,
        memory: NDArray[np.int8],
    ) -> FilterResult:
        n = len(seen)
        memory = memory.copy()
        work = self._prepare(seen, nominal, given, active, memory)
        action = nominal.copy()
        mode, row, reason = np.zeros((3, n), dtype=np.int8)
        reasons: list[str | None] = [None] * n
        if (work.rows != PASSES).any():
            solution, solved = self._solve(work)
            finish(
                self._settings,
                work.states,
                work.obstacles,
                work.count,
                work.barrier,
                work.rows,
                work.readings,
                solution,
                solved,
                action,
                mode,
                row,
                reason,
                memory,
            )
            reasons = [REASONS[code] for code in reason.tolist()]
        after = FilterMemory(memory[:, SIDE], memory[:, PLAN])
        return FilterResult(action, mode, work.barrier, work.hazard, row, reasons, after)


_default = BarrierFilter()


def committed_backup(observation: ArrayLike, hazards: ArrayLike | None = None) -> FloatArray:
    """The action (2,) that the default filter takes for one observation if the policy asks for nothing.

    Args:
        observation: (60,) or (28,).
        hazards: (n, 2) in the body frame [m]; None: from the lidar.

    Raises:
        FilterInputError: if an input has a wrong shape or a value that is not finite.
    """
    given = None if hazards is None else np.asarray(hazards)[None]
    action: FloatArray = _default.filter(np.asarray(observation)[None], np.zeros((1, 2)), given).action[0]
    return action


def _check_inputs(observation: ArrayLike, nominal_action: ArrayLike) -> tuple[FloatArray, FloatArray]:
    seen = _array("observation", observation)
    if seen.ndim != 2 or seen.shape[1] not in _COLUMNS:
        sizes = " or ".join(f"(N, {size})" for size in sorted(_COLUMNS, reverse=True))
        raise FilterInputError("observation", f"expected shape {sizes}, got {seen.shape}")
    nominal = _array("nominal_action", nominal_action)
    if nominal.shape != (len(seen), 2):
        raise FilterInputError("nominal_action", f"expected shape ({len(seen)}, 2), got {nominal.shape}")
    for field, values in (("observation", seen), ("nominal_action", nominal)):
        if not np.isfinite(values).all():
            raise FilterInputError(field, "has values that are not finite")
    return seen, nominal


def _check_hazards(hazards: ArrayLike, n: int) -> FloatArray:
    given = _array("hazards", hazards)
    if given.ndim != 3 or given.shape[0] != n or given.shape[2] != 2:
        raise FilterInputError("hazards", f"expected shape ({n}, n, 2), got {given.shape}")
    finite = np.isfinite(given)
    if not finite.all() and not (finite.all(axis=2) | np.isnan(given).all(axis=2)).all():
        raise FilterInputError("hazards", "has values that are not finite; an absent hazard is NaN in both")
    return given


def _check_active(active: ArrayLike, n: int) -> BoolArray:
    gate = np.ascontiguousarray(active, dtype=np.bool_)
    if gate.shape != (n,):
        raise FilterInputError("active", f"expected shape ({n},), got {gate.shape}")
    return gate


def _check_memory(memory: FilterMemory, n: int) -> NDArray[np.int8]:
    if memory.side.shape != (n,) or memory.plan.shape != (n,):
        shapes = f"{memory.side.shape} and {memory.plan.shape}"
        raise FilterInputError("memory", f"expected that of {n} robots, got shapes {shapes}")
    past = np.empty((n, 2), dtype=np.int8)
    past[:, SIDE] = memory.side
    past[:, PLAN] = np.where((memory.plan >= 0) & (memory.plan <= MOST_PLAN), memory.plan, 0)
    return past


def _array(field: str, values: ArrayLike) -> FloatArray:
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FilterInputError(field, f"is not an array of numbers: {error}") from error
