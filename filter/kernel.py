"""The decision, robot by robot, in compiled loops: what comes before the QP is solved, and what after."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from filter.backups import BACKUPS, FORWARD, STEPS, best_backup
from filter.certificate import certify
from filter.compiled import SOURCES, compiled, entry
from filter.config import Settings
from filter.detour import drives_round, shortest_path, steer
from filter.lidar import decode, decode_goal, likeliest
from filter.obstacles import FAR, least_gap
from filter.qp import build_rows
from filter.recovery import commit, drive_out, first_action
from filter.robot import State, stopping
from pointgoal.observation import LIDAR_RANGE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.int8]
BoolArray = NDArray[np.bool_]

NOMINAL, FILTERED, FALLBACK = 0, 1, 2
"""Values of `Mode`."""
NO_ROW, BARRIER_ROW, DETOUR_ROW, SEARCH_ROW, BACKUP_ROW = 0, 1, 2, 3, 4
"""Values of `Row`."""
NO_REASON, COMMITTED, INSIDE, TOO_FAST = 0, 1, 2, 3
"""Indices into `REASONS`."""
SIDE, PLAN = 0, 1
"""Columns of the memory; see `FilterMemory`."""
MOST_PLAN = BACKUPS * (STEPS + 1)
"""Largest number that stands for a plan."""
PASSES, DRIVES_ROUND = -1, -2
"""In place of a number of rows: the nominal action passes; the detour's action is certified as it is."""
_GRID = 5
"""Thrusts, and turns, that the search tries."""
_THRUST_TIME = 0.02 * (STEPS + 1)
"""Longest thrust in a certificate [s]."""


@compiled
def _reach(config: Settings, state: State) -> float:
    """How far the robot can get within one step and any backup [m]."""
    robot = config.robot
    speed = math.hypot(state.vx, state.vy) + robot.offset * abs(state.yaw_rate)
    return robot.mass / robot.drag * speed + robot.gear * robot.force_limit / robot.drag * _THRUST_TIME + 0.05


@compiled
def _grown(config: Settings, distance: float) -> float:
    """Radius [m] of an obstacle for a hazard measured at a distance [m]: the hazard's own and the margin."""
    return config.hazard_radius + config.margin + config.bearing_error * distance


@compiled
def _obstacles(
    config: Settings, state: State, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray
) -> int:
    """The obstacles within reach, from a lidar scan (16,) or, if that is empty, given ones; how many."""
    reach = _reach(config, state)
    if readings.size > 0:
        grow = _grown(config, 0.0)
        return decode(readings, reach + grow, grow, config.bearing_error, out, source)
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        distance = math.hypot(x, y)
        radius = _grown(config, distance)
        # Not so for a NaN, which marks an absent hazard.
        if distance - radius <= reach:
            out[count, 0] = x
            out[count, 1] = y
            out[count, 2] = 0.0
            out[count, 3] = 0.0
            out[count, 4] = radius
            out[count, 5] = 0.0
            out[count, 6] = distance - radius
            source[count] = i
            count += 1
    return count


@compiled
def _discs(
    config: Settings, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray
) -> int:
    """What to drive round: discs (x, y, radius) with the margin and a clearance; how many there are."""
    if readings.size > 0:
        return likeliest(readings, _grown(config, 0.0) + config.clearance, out, source)
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        if math.isnan(x):
            continue
        out[count, 0] = x
        out[count, 1] = y
        out[count, 2] = _grown(config, math.hypot(x, y)) + config.clearance
        source[count] = i
        count += 1
    return count


@compiled
def _detour(
    config: Settings,
    discs: FloatArray,
    count: int,
    goal: tuple[bool, float, float],
    state: State,
    nominal: FloatArray,
    refused: bool,
    memory: ByteArray,
    reference: FloatArray,
) -> tuple[bool, int]:
    """Whether to drive round something, and which disc that is.

    It is so while a hazard stands in the straight way to the goal and the nominal action does not drive
    round it by itself, and also where the robot hardly moves and the nominal action is refused: such a robot
    would stay there.

    Args:
        config: the filter's numbers.
        discs: (M, 3).
        count: how many of them there are.
        goal: whether it is seen, and where it is [m].
        state: the measured state.
        nominal: (2,).
        refused: whether the nominal action has no certificate.
        memory: (2,) its remembered side is read, and the new one written.
        reference: (2,) receives the QP's reference, if so.

    Returns:
        Whether to, and the disc in the way, -1 if it is not known.
    """
    side = memory[SIDE]
    memory[SIDE] = 0
    seen, goal_x, goal_y = goal
    if config.lookahead <= 0.0 or not seen:
        return False, -1
    now = stopping(config.robot, state)
    way = shortest_path(discs, count, (goal_x, goal_y), (now.zx, now.zy), side, config.steadiness)
    blocked = way.blocker >= 0 and way.distance < config.lookahead
    if blocked:
        memory[SIDE] = way.side
        if not refused and drives_round(config, discs, count, state, nominal, way):
            return False, -1
    elif not (refused and math.hypot(now.zx, now.zy) < config.slow):
        return False, -1
    thrust, turn = steer(config, discs, count, state, way.x, way.y)
    reference[0] = thrust
    reference[1] = turn
    return True, way.blocker


@compiled
def _plan(backup: int, steps: int) -> int:
    """A backup and its steps of thrust as one number above 0."""
    return 1 + backup + BACKUPS * steps


@compiled
def _go_on(config: Settings, state: State, memory: ByteArray) -> tuple[float, float]:
    """The next action (u1, u2) of the plan of the last certificate; the memory keeps the rest of it."""
    backup = (memory[PLAN] - 1) % BACKUPS
    steps = (memory[PLAN] - 1) // BACKUPS
    if steps == 0:
        return 0.0, 0.0
    memory[PLAN] = _plan(backup, steps - 1)
    return first_action(config, backup, stopping(config.robot, state))


@compiled
def _search(
    config: Settings,
    obstacles: FloatArray,
    count: int,
    state: State,
    x: FloatArray,
    action: FloatArray,
    memory: ByteArray,
) -> bool:
    """The certified action nearest to x on a grid, in the QP's norm; False if there is none."""
    limit = config.robot.force_limit
    best = FAR
    for i in range(_GRID):
        f = 1.0 - 2.0 * i / (_GRID - 1)
        for j in range(_GRID):
            w = 1.0 - 2.0 * j / (_GRID - 1)
            cost = config.thrust_weight * (f - x[0]) ** 2 + (w - x[1]) ** 2
            if cost >= best:
                continue
            value, _, backup, steps = certify(config, obstacles, count, state, f * limit, w, 0.0)
            if value >= 0.0:
                best = cost
                memory[PLAN] = _plan(backup, steps)
                action[0] = f * limit
                action[1] = w
    return best < FAR


@compiled
def _why(margin: float, edge: float, barrier: float) -> int:
    """The reason for a fallback, by the margin, the distance to a hazard's edge, and the barrier [m]."""
    if edge < 0.0:
        return INSIDE
    return TOO_FAST if barrier < -margin else COMMITTED


@compiled
def _fall_back(
    config: Settings,
    obstacles: FloatArray,
    count: int,
    state: State,
    barrier: float,
    here: float,
    edge: float,
    scanned: bool,
    action: FloatArray,
    memory: ByteArray,
) -> int:
    """Find the action to send where nothing keeps the whole margin; arguments as for `_repair`.

    Returns:
        The reason.
    """
    reason = _why(config.margin, edge, barrier)
    if reason == INSIDE:
        action[0], action[1] = drive_out(config, obstacles, count, state)
        memory[PLAN] = 0
        return reason
    # What the model errs by, and the sensors, is kept whatever happens; the rest of the margin is not. A
    # robot that stands nearer than that may go wherever it comes no nearer.
    least = min(config.sure - config.margin, 0.0)
    if not _moves(config, state):
        least = min(least, here)
    thrust, turn, kept, backup, steps = commit(config, obstacles, count, state, least)
    if kept:
        memory[PLAN] = _plan(backup, steps)
        reason = COMMITTED
    elif scanned and memory[PLAN] > 0:
        # A scan can leave places possible that the last one had ruled out, and then no backup keeps out of
        # them all. The plan was certified against those possible then, and the hazards are among them.
        thrust, turn = _go_on(config, state, memory)
        reason = COMMITTED
    else:
        memory[PLAN] = 0
    action[0] = thrust
    action[1] = turn
    return reason


@compiled
def _moves(config: Settings, state: State) -> bool:
    """Whether there is motion worth a plan."""
    now = stopping(config.robot, state)
    return math.hypot(now.zx, now.zy) > config.slow


@compiled
def _repair(
    config: Settings,
    obstacles: FloatArray,
    count: int,
    state: State,
    barrier: float,
    readings: FloatArray,
    solved: bool,
    solution: FloatArray,
    action: FloatArray,
    memory: ByteArray,
) -> tuple[int, int, int]:
    """Turn a QP's solution into an action to send: itself, else the nearest certified one, else the way out.

    Args:
        config: the filter's numbers.
        obstacles: (M, COLUMNS).
        count: how many of them there are.
        state: the measured state.
        barrier: of the state [m].
        readings: (16,) the hazards' lidar, or (0,).
        solved: whether there is a solution.
        solution: (2,) it, or the reference.
        action: (2,) receives u1, u2.
        memory: (2,) its plan is read, and the new one written.

    Returns:
        Mode, row and reason.
    """
    thrust = solution[0] * config.robot.force_limit
    turn = solution[1]
    least = config.hysteresis
    value, _, backup, steps = certify(config, obstacles, count, state, thrust, turn, least)
    if solved and value >= least:
        action[0] = thrust
        action[1] = turn
        memory[PLAN] = _plan(backup, steps)
        return FILTERED, BARRIER_ROW, NO_REASON
    here, _ = least_gap(obstacles, count, 0.0, 0.0, 0.0, 0.0, -1, -FAR)
    if here >= 0.0 and _search(config, obstacles, count, state, solution, action, memory):
        return FILTERED, SEARCH_ROW, NO_REASON
    # A scan tells how far the nearest hazard is, though not where.
    scanned = readings.size > 0
    edge = here + config.margin
    if scanned:
        edge = LIDAR_RANGE * (1.0 - np.max(readings)) - config.hazard_radius
    reason = _fall_back(config, obstacles, count, state, barrier, here, edge, scanned, action, memory)
    return FALLBACK, BACKUP_ROW, reason


@compiled
def _screen(
    config: Settings,
    state: State,
    given: FloatArray,
    readings: FloatArray,
    goal: FloatArray,
    nominal: FloatArray,
    memory: ByteArray,
    obstacles: FloatArray,
    source: IntArray,
    count: int,
    best: tuple[float, int, int, int],
    reference: FloatArray,
    G: FloatArray,
    h: FloatArray,
    scratch: tuple[FloatArray, FloatArray, IntArray],
) -> tuple[int, int]:
    """Screen one robot's nominal action, and build its QP if it does not pass; arguments as for ``prepare``.

    Returns:
        How many rows the QP has, or `PASSES` or `DRIVES_ROUND`; what the intervention comes from, or -1.
    """
    work, discs, labels = scratch
    limit = config.robot.force_limit
    least = config.hysteresis
    value, at, backup, steps = certify(config, obstacles, count, state, nominal[0], nominal[1], least)
    refused = value < least
    m = _discs(config, given, readings, discs, labels)
    detour, blocker = _detour(config, discs, m, decode_goal(goal), state, nominal, refused, memory, reference)
    if not (refused or detour):
        memory[PLAN] = _plan(backup, steps)
        return PASSES, -1
    hazard = labels[blocker] if detour and blocker >= 0 else source[at]
    if not detour:
        reference[0] = min(max(nominal[0] / limit, -1.0), 1.0)
        reference[1] = min(max(nominal[1], -1.0), 1.0)
    else:
        value, _, backup, steps = certify(
            config, obstacles, count, state, reference[0] * limit, reference[1], least
        )
        if value >= least:
            memory[PLAN] = _plan(backup, steps)
            return DRIVES_ROUND, hazard
    return build_rows(config, obstacles, count, state, best, reference, G, h, work), hazard


def _prepare_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def prepare(
        config: Settings,
        states: FloatArray,
        given: FloatArray,
        readings: FloatArray,
        goals: FloatArray,
        nominal: FloatArray,
        active: BoolArray,
        memory: ByteArray,
        obstacles: FloatArray,
        source: IntArray,
        count: IntArray,
        barrier: FloatArray,
        hazard: IntArray,
        reference: FloatArray,
        G: FloatArray,
        h: FloatArray,
        rows: IntArray,
    ) -> None:
        """Decode, screen the nominal actions, and build the QPs of those that do not pass.

        Args:
            config: the filter's numbers.
            states: (N, 3) velocity ahead and to the left [m/s], yaw rate [rad/s].
            given: (N, n, 2) hazards [m], used if there are no readings.
            readings: (N, 16) the hazards' lidar, or (N, 0).
            goals: (N, 16) the goal's lidar.
            nominal: (N, 2).
            active: (N,).
            memory: (N, 2); overwritten.
            obstacles: (N, M, COLUMNS), and all that follows, receive the results.
            source: (N, M) each obstacle's hazard or bin.
            count: (N,) how many obstacles there are.
            barrier: (N,) [m].
            hazard: (N,) what the intervention comes from, -1 if there is none.
            reference: (N, 2) of the QP.
            G: (N, M, 2).
            h: (N, M).
            rows: (N,) how many rows the QP has; `PASSES` or `DRIVES_ROUND` if there is none.
        """
        if not sources:
            return
        size = max(obstacles.shape[1], 16)
        scratch = (np.empty((4, size)), np.empty((size, 3)), np.empty(size, dtype=np.int64))
        for k in range(states.shape[0]):
            state = State(0.0, 0.0, 0.0, states[k, 0], states[k, 1], states[k, 2])
            near = obstacles[k]
            rows[k] = PASSES
            hazard[k] = -1
            n = _obstacles(config, state, given[k], readings[k], near, source[k])
            count[k] = n
            best = best_backup(config, near, n, stopping(config.robot, state), FAR)
            barrier[k] = min(best[0], LIDAR_RANGE) if n > 0 else LIDAR_RANGE
            if not active[k]:
                memory[k] = 0
            elif n == 0:
                # Nothing is within reach of any backup: to coast is a plan that the next scan cannot refute.
                memory[k] = (0, _plan(FORWARD, 0))
            else:
                rows[k], hazard[k] = _screen(
                    config,
                    state,
                    given[k],
                    readings[k],
                    goals[k],
                    nominal[k],
                    memory[k],
                    near,
                    source[k],
                    n,
                    best,
                    reference[k],
                    G[k],
                    h[k],
                    scratch,
                )

    return prepare


def _finish_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def finish(
        config: Settings,
        states: FloatArray,
        obstacles: FloatArray,
        count: IntArray,
        barrier: FloatArray,
        rows: IntArray,
        readings: FloatArray,
        solution: FloatArray,
        solved: BoolArray,
        action: FloatArray,
        mode: ByteArray,
        row: ByteArray,
        reason: ByteArray,
        memory: ByteArray,
    ) -> None:
        """Turn the solutions into certified actions.

        Args:
            config: the filter's numbers.
            states: (N, 3) as for ``prepare``.
            obstacles: (N, M, COLUMNS), as ``prepare`` left them, as are the next three.
            count: (N,).
            barrier: (N,).
            rows: (N,).
            readings: (N, 16) the hazards' lidar, or (N, 0).
            solution: (N, 2) of the QPs, the reference where there is none.
            solved: (N,) whether there is one.
            action: (N, 2) the nominal ones; overwritten where they do not pass.
            mode: (N,) zeros; receives `Mode`.
            row: (N,) zeros; receives `Row`.
            reason: (N,) zeros; receives the index into `REASONS`.
            memory: (N, 2), as ``prepare`` left it; overwritten.
        """
        if not sources:
            return
        for k in range(states.shape[0]):
            if rows[k] == DRIVES_ROUND:
                mode[k] = FILTERED
                row[k] = DETOUR_ROW
                action[k, 0] = solution[k, 0] * config.robot.force_limit
                action[k, 1] = solution[k, 1]
            elif rows[k] != PASSES:
                state = State(0.0, 0.0, 0.0, states[k, 0], states[k, 1], states[k, 2])
                mode[k], row[k], reason[k] = _repair(
                    config,
                    obstacles[k],
                    count[k],
                    state,
                    barrier[k],
                    readings[k],
                    solved[k],
                    solution[k],
                    action[k],
                    memory[k],
                )

    return finish


prepare = _prepare_entry()
finish = _finish_entry()
