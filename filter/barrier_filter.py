"""The filter: nominal action in, certified action out. A batch at a time; one robot is a batch of one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter.backups import best_backup, law
from filter.certificate import certify
from filter.compiled import SOURCES, compiled, entry
from filter.config import FilterConfig, Settings, settings
from filter.errors import FilterInputError, SolverError
from filter.detour import shortest_path, steer
from filter.lidar import CONES, decode, decode_goal, likeliest
from filter.obstacles import COLUMNS, FAR, least_gap
from filter.qp import Problem, build_rows
from filter.recovery import drive_out
from filter.robot import State, stopping
from filter.solvers import TOLERANCE, Solver, solve_batch, solver
from pointgoal.observation import LIDAR_BINS, LIDAR_RANGE, layout

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SAFE_ACTION = (0.0, 0.0)
"""Zero thrust, no turn: what to send when nothing is known."""
_CHUNK = 512
"""Robots handled at once: bounds the memory of the obstacles."""


class Mode(IntEnum):
    """What became of the nominal action."""

    NOMINAL = 0
    """It passed, bit for bit."""
    FILTERED = 1
    """Another action was certified in its place."""
    FALLBACK = 2
    """Nothing is certified: the committed backup, or the way out of a hazard."""


class Row(IntEnum):
    """What the intervention came from."""

    NONE = 0
    """There was none."""
    BARRIER = 1
    """A barrier row of the QP: the nominal action would have let a clearance fall too fast."""
    DETOUR = 4
    """A hazard is in the straight way to the goal: the action drives round it."""
    SEARCH = 2
    """The QP's action had no certificate; the nearest certified one was sent."""
    BACKUP = 3
    """No action had a certificate; the backup with the most clearance was sent."""


REASONS = (
    None,
    "no certified action: committed backup",
    "inside a hazard: driving out",
    "too fast to stay clear of a hazard: least violation",
)
"""The reasons that a fallback gives, by their number."""


@dataclass(frozen=True)
class FilterMemory:
    """What a robot's filter remembers from step to step. It may be left out.

    Attributes:
        side: (N,) int8, the side on which the robot passes what is in its way: 1 left, -1 right, 0 none.
    """

    side: NDArray[np.int8]

    @staticmethod
    def empty(n: int) -> FilterMemory:
        """The memory of n robots before their first step."""
        return FilterMemory(np.zeros(n, dtype=np.int8))


@dataclass(frozen=True)
class FilterResult:
    """What the filter decided, for N robots.

    Attributes:
        action: (N, 2) what to send.
        mode: (N,) int8, see `Mode`.
        barrier: (N,) clearance [m] that the best backup keeps from the present state; below 0 there is none.
        hazard: (N,) index of the hazard (given hazards) or of the lidar bin that the intervention came from; -1: none.
        row: (N,) int8, see `Row`.
        reason: N texts for the fallbacks, else None.
        memory: to pass to the next call.
    """

    action: FloatArray
    mode: NDArray[np.int8]
    barrier: FloatArray
    hazard: IntArray
    row: NDArray[np.int8]
    reason: list[str | None]
    memory: FilterMemory


@compiled
def _reach(config: Settings, state: State) -> float:
    """How far the robot can get within one step and any backup [m]."""
    robot = config.robot
    speed = math.hypot(state.vx, state.vy) + robot.offset * abs(state.yaw_rate)
    return robot.mass / robot.drag * speed + robot.gear * robot.force_limit / robot.drag * 0.52 + 0.05


@compiled
def _select(
    config: Settings, given: FloatArray, reach: float, obstacles: FloatArray, source: IntArray
) -> int:
    """Turn the given hazards within reach into obstacles; how many there are."""
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        distance = math.hypot(x, y)
        radius = config.hazard_radius + config.margin + config.bearing_error * distance
        if distance - radius <= reach:
            obstacles[count] = (x, y, 0.0, 0.0, radius, 0.0, distance - radius)
            source[count] = i
            count += 1
    return count


@compiled
def _discs(config: Settings, given: FloatArray, out: FloatArray, source: IntArray) -> int:
    """The given hazards as discs to drive round; how many there are."""
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        if x == x:
            radius = config.hazard_radius + config.margin + config.bearing_error * math.hypot(x, y)
            out[count] = (x, y, radius + config.clearance)
            source[count] = i
            count += 1
    return count


@compiled
def _search(
    config: Settings, obstacles: FloatArray, count: int, state: State, x: FloatArray, action: FloatArray
) -> bool:
    """The certified action nearest to x on a grid, in the QP's norm; False if there is none."""
    limit = config.robot.force_limit
    best = 1e9
    for i in range(5):
        f = 1.0 - 0.5 * i
        for j in range(5):
            w = 1.0 - 0.5 * j
            cost = config.thrust_weight * (f - x[0]) ** 2 + (w - x[1]) ** 2
            if cost < best and certify(config, obstacles, count, state, f * limit, w, 0.0)[0] >= 0.0:
                best = cost
                action[0] = f * limit
                action[1] = w
    return best < 1e9


@compiled
def _backup_action(config: Settings, obstacles: FloatArray, count: int, state: State) -> tuple[float, float]:
    """First action (u1, u2) of the backup with the most clearance."""
    robot = config.robot
    at = stopping(robot, state)
    _, _, kind, steps = best_backup(config, obstacles, count, at, 1e9)
    if steps == 0:
        return 0.0, 0.0
    thrust, turn = law(config, kind, at)
    most = robot.gear / (robot.gear * robot.gear + robot.yaw_drag) * robot.physics_step * robot.substeps
    return thrust * robot.force_limit, turn / most


@compiled
def _why(config: Settings, obstacles: FloatArray, count: int, barrier: float) -> int:
    """The number of the reason for a fallback, see `REASONS`."""
    here, _ = least_gap(obstacles, count, 0.0, 0.0, 0.0, 0.0, -1, -FAR)
    if here < -config.margin:
        return 2
    return 3 if barrier < -config.margin else 1


def _entries() -> tuple[Callable[..., None], ...]:
    sources = SOURCES

    @entry
    def prepare(
        config: Settings,
        states: FloatArray,
        given: FloatArray,
        readings: FloatArray,
        goals: FloatArray,
        sides: NDArray[np.int8],
        nominal: FloatArray,
        active: BoolArray,
        obstacles: FloatArray,
        source: IntArray,
        count: IntArray,
        barrier: FloatArray,
        hazard: IntArray,
        reference: FloatArray,
        G: FloatArray,
        h: FloatArray,
        rows: IntArray,
        origin: IntArray,
        discs: FloatArray,
        disc_source: IntArray,
    ) -> None:
        """Decode, screen, and build the QPs of those robots whose nominal action is not certified (rows >= 0)."""
        if not sources:
            return
        work = np.empty((4, obstacles.shape[1]))
        limit = config.robot.force_limit
        for k in range(states.shape[0]):
            state = State(0.0, 0.0, 0.0, states[k, 0], states[k, 1], states[k, 2])
            reach = _reach(config, state)
            if readings.shape[1] > 0:
                grow = config.hazard_radius + config.margin
                n = decode(readings[k], reach + grow, grow, config.bearing_error, obstacles[k], source[k])
            else:
                n = _select(config, given[k], reach, obstacles[k], source[k])
            count[k] = n
            rows[k] = -1
            hazard[k] = -1
            side = sides[k]
            sides[k] = 0
            if n == 0:
                barrier[k] = LIDAR_RANGE
                continue
            value, _, _, _ = best_backup(config, obstacles[k], n, stopping(config.robot, state), 1e9)
            barrier[k] = min(value, LIDAR_RANGE)
            if not active[k]:
                continue
            hazard[k] = -1
            detour = False
            value, blocker, _, _ = certify(
                config, obstacles[k], n, state, nominal[k, 0], nominal[k, 1], config.hysteresis
            )
            if config.lookahead > 0.0:
                found, goal_x, goal_y = decode_goal(goals[k])
                if found:
                    if readings.shape[1] > 0:
                        m = likeliest(readings[k], grow + config.clearance, discs, disc_source)
                    else:
                        m = _discs(config, given[k], discs, disc_source)
                    now = stopping(config.robot, state)
                    way = shortest_path(discs, m, goal_x, goal_y, now.zx, now.zy, side, config.mind)
                    stuck = value < config.hysteresis and math.hypot(now.zx, now.zy) < config.slow
                    detour = way.blocker >= 0 and way.distance < config.lookahead
                    if detour:
                        sides[k] = way.side
                        hazard[k] = disc_source[way.blocker]
                    elif stuck:
                        hazard[k] = source[k, blocker]
                        detour = True
                    if detour:
                        reference[k] = steer(config, discs, m, state, way.x, way.y)
                        value, _, _, _ = certify(
                            config,
                            obstacles[k],
                            n,
                            state,
                            reference[k, 0] * limit,
                            reference[k, 1],
                            config.hysteresis,
                        )
                        if value >= config.hysteresis:
                            rows[k] = -2
                        else:
                            rows[k] = build_rows(
                                config, obstacles[k], n, state, reference[k], G[k], h[k], origin[k], work
                            )
                        continue
            if value >= config.hysteresis:
                continue
            hazard[k] = source[k, blocker]
            reference[k, 0] = min(max(nominal[k, 0] / limit, -1.0), 1.0)
            reference[k, 1] = nominal[k, 1]
            rows[k] = build_rows(config, obstacles[k], n, state, reference[k], G[k], h[k], origin[k], work)

    @entry
    def finish(
        config: Settings,
        states: FloatArray,
        obstacles: FloatArray,
        count: IntArray,
        barrier: FloatArray,
        rows: IntArray,
        solution: FloatArray,
        solved: BoolArray,
        action: FloatArray,
        mode: NDArray[np.int8],
        row: NDArray[np.int8],
        reason: NDArray[np.int8],
    ) -> None:
        """Certify the solutions; where that fails, search, and where that fails, take the committed backup."""
        if not sources:
            return
        limit = config.robot.force_limit
        for k in range(states.shape[0]):
            if rows[k] == -1:
                continue
            if rows[k] == -2:
                mode[k] = 1
                row[k] = 4
                action[k, 0] = solution[k, 0] * limit
                action[k, 1] = solution[k, 1]
                continue
            state = State(0.0, 0.0, 0.0, states[k, 0], states[k, 1], states[k, 2])
            n = count[k]
            mode[k] = 1
            if solved[k]:
                f, w = solution[k]
                if (
                    certify(config, obstacles[k], n, state, f * limit, w, config.hysteresis)[0]
                    >= config.hysteresis
                ):
                    action[k, 0] = f * limit
                    action[k, 1] = w
                    row[k] = 1
                    continue
            if _search(config, obstacles[k], n, state, solution[k], action[k]):
                row[k] = 2
                continue
            mode[k] = 2
            row[k] = 3
            reason[k] = _why(config, obstacles[k], n, barrier[k])
            action[k] = drive_out(config, obstacles[k], n, state)

    @entry
    def backups(
        config: Settings, states: FloatArray, obstacles: FloatArray, count: IntArray, action: FloatArray
    ) -> None:
        """The first action of each robot's best backup."""
        if not sources:
            return
        for k in range(states.shape[0]):
            state = State(0.0, 0.0, 0.0, states[k, 0], states[k, 1], states[k, 2])
            action[k] = _backup_action(config, obstacles[k], count[k], state)

    return prepare, finish, backups


_prepare, _finish, _backups = _entries()


class BarrierFilter:
    """Turns nominal actions into certified ones. It keeps no state between calls, so one serves any number of robots."""

    def __init__(self, config: FilterConfig | None = None) -> None:
        self.config = FilterConfig() if config is None else config
        self._settings = settings(self.config)
        self._weights = np.array([self.config.thrust_weight, 1.0])
        self._solver: Solver | None = None if self.config.solver == "planar" else solver(self.config.solver)

    def filter(
        self,
        observation: FloatArray,
        nominal_action: FloatArray,
        hazards: FloatArray | None = None,
        memory: FilterMemory | None = None,
        active: BoolArray | None = None,
    ) -> FilterResult:
        """Filter N actions.

        Args:
            observation: (N, 60), or (N, 28) at level 0.
            nominal_action: (N, 2), each in [-1, 1].
            hazards: (N, n, 2) centres in the body frame, x ahead and y to the left [m]; rows of NaN are absent ones.
                None: decode them from the lidar.
            memory: what the last call returned, or None.
            active: (N,) where False, the nominal action passes as it is. None: all True.

        Returns:
            The actions and what led to them.

        Raises:
            FilterInputError: if an input has a wrong shape or a value that is not finite.
        """
        observation, nominal = _check_inputs(observation, nominal_action)
        n = len(observation)
        given = None if hazards is None else _check_hazards(hazards, n)
        active = np.ones(n, dtype=bool) if active is None else _check_active(active, n)
        memory = FilterMemory.empty(n) if memory is None else _check_memory(memory, n)
        parts = [
            self._chunk(
                observation[i : i + _CHUNK],
                nominal[i : i + _CHUNK],
                None if given is None else given[i : i + _CHUNK],
                active[i : i + _CHUNK],
                memory.side[i : i + _CHUNK],
            )
            for i in range(0, n, _CHUNK)
        ]
        if len(parts) == 1:
            action, mode, barrier, hazard, row, reason, side = parts[0]
        else:
            action, mode, barrier, hazard, row, reason, side = (
                np.concatenate([part[i] for part in parts]) if parts else _EMPTY[i] for i in range(7)
            )
        memory = FilterMemory(side)
        reasons = [REASONS[code] for code in reason.tolist()]
        return FilterResult(action, mode, barrier, hazard, row, reasons, memory)

    def problem(
        self, observation: FloatArray, nominal_action: FloatArray, hazards: FloatArray | None = None
    ) -> Problem | None:
        """The QP of one robot, observation (60,), action (2,), hazards (n, 2); None where the action passes."""
        observation, nominal = _check_inputs(np.asarray(observation)[None], np.asarray(nominal_action)[None])
        given = None if hazards is None else _check_hazards(np.asarray(hazards)[None], 1)
        work = self._prepare(observation, nominal, given, np.ones(1, dtype=bool), np.zeros(1, dtype=np.int8))
        return self._problem(work, 0) if work["rows"][0] >= 0 else None

    def backup(self, observation: FloatArray, hazards: FloatArray | None = None) -> FloatArray:
        """The first actions (N, 2) of the backups with the most clearance, whatever the policies want.

        Args:
            observation: (N, 60) or (N, 28).
            hazards: (N, n, 2) in the body frame [m]; None: from the lidar.

        Raises:
            FilterInputError: if an input has a wrong shape or a value that is not finite.
        """
        n = len(observation)
        observation, action = _check_inputs(observation, np.zeros((n, 2)))
        given = None if hazards is None else _check_hazards(hazards, n)
        work = self._prepare(observation, action, given, np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int8))
        _backups(self._settings, work["states"], work["obstacles"], work["count"], action)
        return action

    def _prepare(
        self,
        observation: FloatArray,
        nominal: FloatArray,
        given: FloatArray | None,
        active: BoolArray,
        side: NDArray[np.int8],
    ) -> dict[str, Any]:
        n = len(observation)
        where = layout(0 if observation.shape[1] == _SIZES[0] else 1)
        motion = where.slice("velocimeter").start
        states = observation[:, [motion, motion + 1, where.slice("gyro").stop - 1]]
        readings = _NO_READINGS
        if given is None and "hazards_lidar" in where:
            readings = np.ascontiguousarray(observation[:, where.slice("hazards_lidar")])
            size = CONES
        else:
            given = np.empty((n, 0, 2)) if given is None else given
            size = given.shape[1]
        if given is None:
            given = np.empty((n, 0, 2))
        work: dict[str, Any] = {
            "states": states,
            "obstacles": np.empty((n, size, COLUMNS)),
            "source": np.empty((n, size), dtype=np.int64),
            "count": np.empty(n, dtype=np.int64),
            "barrier": np.empty(n),
            "hazard": np.empty(n, dtype=np.int64),
            "reference": np.empty((n, 2)),
            "G": np.empty((n, size, 2)),
            "h": np.empty((n, size)),
            "rows": np.empty(n, dtype=np.int64),
            "origin": np.empty((n, size), dtype=np.int64),
            "discs": np.empty((max(size, LIDAR_BINS), 3)),
            "disc_source": np.empty(max(size, LIDAR_BINS), dtype=np.int64),
        }
        goals = np.ascontiguousarray(observation[:, where.slice("goal_lidar")])
        outputs = list(work.values())[1:]
        _prepare(self._settings, states, given, readings, goals, side, nominal, active, *outputs)
        return work

    def _problem(self, work: dict[str, Any], k: int) -> Problem:
        rows = work["rows"][k]
        return Problem(self._weights, work["reference"][k], work["G"][k, :rows], work["h"][k, :rows])

    def _solve(self, work: dict[str, Any]) -> tuple[FloatArray, BoolArray]:
        """Solve the QPs: the solutions (N, 2), the reference where there is none, and where there is one (N,)."""
        solution = work["reference"].copy()
        solved = np.zeros(len(solution), dtype=bool)
        if self._solver is None:
            solve_batch(
                self._weights, work["reference"], work["G"], work["h"], work["rows"], solution, solved
            )
            return solution, solved
        for k in np.flatnonzero(work["rows"] >= 0):
            problem = self._problem(work, int(k))
            try:
                x = self._solver(problem)
            except SolverError:
                continue  # the search finds a certified action without the QP
            if x is not None and problem.residual(x) <= TOLERANCE:
                solution[k], solved[k] = np.clip(x, -1.0, 1.0), True
        return solution, solved

    def _chunk(
        self,
        observation: FloatArray,
        nominal: FloatArray,
        given: FloatArray | None,
        active: BoolArray,
        side: NDArray[np.int8],
    ) -> tuple[Any, ...]:
        side = side.copy()
        work = self._prepare(observation, nominal, given, active, side)
        n = len(observation)
        action = nominal.copy()
        mode, row, reason = np.zeros((3, n), dtype=np.int8)
        if (work["rows"] != -1).any():
            solution, solved = self._solve(work)
            names = ("states", "obstacles", "count", "barrier", "rows")
            _finish(
                self._settings, *(work[name] for name in names), solution, solved, action, mode, row, reason
            )
        return action, mode, work["barrier"], work["hazard"], row, reason, side


def committed_backup(observation: FloatArray, hazards: FloatArray | None = None) -> FloatArray:
    """The first action (2,) of the best backup for one observation, whatever the policy wants.

    Args:
        observation: (60,) or (28,).
        hazards: (n, 2) in the body frame [m]; None: from the lidar.

    Raises:
        FilterInputError: if an input has a wrong shape or a value that is not finite.
    """
    robot = BarrierFilter()
    given = None if hazards is None else np.asarray(hazards)[None]
    return robot.backup(np.asarray(observation)[None], given)[0]


_SIZES = (layout(0).size, layout(1).size)
_NO_READINGS = np.empty((0, 0))
_EMPTY: tuple[NDArray[Any], ...] = (
    np.empty((0, 2)),
    np.empty(0, dtype=np.int8),
    np.empty(0),
    np.empty(0, dtype=np.int64),
    np.empty(0, dtype=np.int8),
    np.empty(0, dtype=np.int8),
    np.empty(0, dtype=np.int8),
)


def _check_inputs(observation: FloatArray, nominal: FloatArray) -> tuple[FloatArray, FloatArray]:
    observation = np.ascontiguousarray(observation, dtype=np.float64)
    if observation.ndim != 2 or observation.shape[1] not in _SIZES:
        raise FilterInputError(
            "observation", f"expected shape (N, {_SIZES[1]}) or (N, {_SIZES[0]}), got {observation.shape}"
        )
    nominal = np.ascontiguousarray(nominal, dtype=np.float64)
    if nominal.shape != (len(observation), 2):
        raise FilterInputError(
            "nominal_action", f"expected shape ({len(observation)}, 2), got {nominal.shape}"
        )
    if not np.isfinite(observation).all():
        raise FilterInputError("observation", "has values that are not finite")
    if not np.isfinite(nominal).all():
        raise FilterInputError("nominal_action", "has values that are not finite")
    return observation, nominal


def _check_hazards(hazards: FloatArray, n: int) -> FloatArray:
    hazards = np.ascontiguousarray(hazards, dtype=np.float64)
    if hazards.ndim != 3 or hazards.shape[0] != n or hazards.shape[2] != 2:
        raise FilterInputError("hazards", f"expected shape ({n}, n, 2), got {hazards.shape}")
    if np.isinf(hazards).any() or (np.isnan(hazards[..., 0]) != np.isnan(hazards[..., 1])).any():
        raise FilterInputError("hazards", "has values that are not finite (absent ones are NaN in both)")
    return hazards


def _check_active(active: BoolArray, n: int) -> BoolArray:
    active = np.ascontiguousarray(active, dtype=bool)
    if active.shape != (n,):
        raise FilterInputError("active", f"expected shape ({n},), got {active.shape}")
    return active


def _check_memory(memory: FilterMemory, n: int) -> FilterMemory:
    if memory.side.shape != (n,):
        raise FilterInputError("memory", f"expected that of {n} robots, got {memory.side.shape}")
    return memory
