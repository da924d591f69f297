"""The numbers of a decision, robot by robot in compiled loops; `barrier_filter` says what they decide.

Each of these takes arrays with a row for each robot, and, where only some robots are meant, the indices of
their rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from decision import PLAN_STEPS
from filter.backups import best_backup, clearances
from filter.certificate import CERTIFICATE
from filter.certificate import certify as certify_one
from filter.circulation import away_of, circulate
from system.backups import law
from system.compiled import SOURCES, compiled, entry
from filter.config import Settings
from system.lidar import decode, unexplained
from system.obstacles import FAR, least_gap
from filter.qp import after, barrier_rows
from filter.recovery import commit, drive_out
from system.point_robot import State, advance, follow, stopping
from pointgoal.observation import LIDAR_RANGE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Records = NDArray[np.void]

SEEN = np.dtype([("vx", "f8"), ("vy", "f8"), ("yaw_rate", "f8"), ("count", "i8"), ("now", CERTIFICATE)])
"""One robot as the filter sees it: its motion ahead and to the left [m/s], its yaw rate [rad/s], how many
obstacles are within reach, and its best backup from here, whose clearance is the barrier."""
_GRID = 5
"""Thrusts, and turns, that the search tries."""
_THRUST_TIME = 0.02 * (PLAN_STEPS + 1)
"""Longest thrust in a certificate [s]."""


@compiled
def _state(seen: Records) -> State:
    """The state of one row of `SEEN`, in the frame of the decision."""
    return State(0.0, 0.0, 0.0, seen.vx, seen.vy, seen.yaw_rate)


@compiled
def _reach(config: Settings, state: State) -> float:
    """How far the robot can get within one step and any backup [m]."""
    robot = config.robot
    speed = math.hypot(state.vx, state.vy) + robot.offset * abs(state.yaw_rate)
    return robot.mass / robot.drag * speed + robot.gear * robot.force_limit / robot.drag * _THRUST_TIME + 0.05


@compiled
def _obstacles(
    config: Settings, state: State, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray
) -> int:
    """The obstacles within reach, the given ones and what of a scan they do not explain; how many."""
    reach = _reach(config, state)
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        distance = math.hypot(x, y)
        radius = config.hazard_radius + config.margin + config.bearing_error * distance
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
    if readings.size == 0:
        return count
    grow = config.hazard_radius + config.margin
    wanted = unexplained(readings, given, config.position_error, config.bearing_error)
    return decode(readings, wanted, reach + grow, grow, config.bearing_error, out, source, count, len(given))


def _see_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def see(
        settings: Records,
        motion: FloatArray,
        given: FloatArray,
        readings: FloatArray,
        seen: Records,
        obstacles: FloatArray,
        source: IntArray,
    ) -> None:
        """Find each robot's obstacles and its best backup.

        Args:
            settings: (1,) of `SETTINGS`.
            motion: (N, 3) velocity ahead and to the left [m/s], yaw rate [rad/s].
            given: (N, n, 2) hazards [m], or (N, 0, 2).
            readings: (N, 16) the hazards' lidar, or (N, 0).
            seen: (N,) of `SEEN`, receives what is seen of each.
            obstacles: (N, M, COLUMNS) receives the obstacles within reach.
            source: (N, M) receives each one's hazard, or n + its bin.
        """
        if not sources:
            return
        config = settings[0]
        for k in range(len(motion)):
            one = seen[k]
            one.vx, one.vy, one.yaw_rate = motion[k]
            state = _state(one)
            one.count = _obstacles(config, state, given[k], readings[k], obstacles[k], source[k])
            now = best_backup(config, obstacles[k], one.count, stopping(config.robot, state), FAR)
            one.now.clearance = min(now[0], LIDAR_RANGE)
            one.now.nearest, one.now.backup, one.now.steps = now[1:]

    return see


def _certify_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def certify(
        settings: Records,
        seen: Records,
        obstacles: FloatArray,
        rows: IntArray,
        action: FloatArray,
        least: FloatArray,
        certificates: Records,
    ) -> None:
        """Look for the certificates of some robots' actions.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            obstacles: (N, M, COLUMNS).
            rows: (n,) which robots.
            action: (n, 2) theirs, u1, u2.
            least: (n,) the clearance to be kept [m].
            certificates: (N,) of `CERTIFICATE`, receives theirs; a clearance at or above ``least`` says no more
                than that, one below only that it is below.
        """
        if not sources:
            return
        config = settings[0]
        for j in range(len(rows)):
            k = rows[j]
            found = certify_one(
                config,
                obstacles[k],
                seen[k].count,
                _state(seen[k]),
                action[j, 0],
                action[j, 1],
                least[j],
            )
            one = certificates[k]
            one.clearance, one.nearest, one.backup, one.steps = found

    return certify


def _linearise_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def linearise(
        settings: Records,
        seen: Records,
        obstacles: FloatArray,
        rows: IntArray,
        about: FloatArray,
        planned: bool,
        G: FloatArray,
        h: FloatArray,
        count: IntArray,
    ) -> None:
        """Write the barrier rows of some robots' QPs.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            obstacles: (N, M, COLUMNS).
            rows: (n,) which robots.
            about: (n, 2) where to linearise, in the QP's variables.
            planned: whether to linearise about the present best backup's own action, which is written to
                ``about``, and to take what is left of that backup; else the best one after the step.
            G: (n, m, 2) receives the rows; m is above the count of any robot's obstacles.
            h: (n, m) receives their right-hand sides.
            count: (n,) receives how many there are.
        """
        if not sources:
            return
        config = settings[0]
        work = np.empty((4, h.shape[1]))
        for j in range(len(rows)):
            k = rows[j]
            one = seen[k]
            state = _state(one)
            now = stopping(config.robot, state)
            clearances(config, one.now.backup, one.now.steps, obstacles[k], one.count, now, work[3])
            if planned:
                backup = (one.now.backup, max(one.now.steps - 1, 0))
                about[j] = law(config.robot, one.now.backup, now) if one.now.steps > 0 else (0.0, 0.0)
                clearances(
                    config,
                    backup[0],
                    backup[1],
                    obstacles[k],
                    one.count,
                    after(config, state, about[j, 0], about[j, 1]),
                    work[0],
                )
                for i in range(one.count):
                    work[3, i] = min(work[3, i], work[0, i])
            else:
                at = after(config, state, about[j, 0], about[j, 1])
                found = best_backup(config, obstacles[k], one.count, at, FAR)
                backup = (found[2], found[3])
            count[j] = barrier_rows(
                config, obstacles[k], one.count, state, work[3], about[j], backup, G[j], h[j], work
            )

    return linearise


def _circulation_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def add_circulation(
        settings: Records,
        seen: Records,
        obstacles: FloatArray,
        rows: IntArray,
        nearest: IntArray,
        reference: FloatArray,
        side: NDArray[np.int8],
        G: FloatArray,
        h: FloatArray,
        count: IntArray,
    ) -> None:
        """Write the circulation row behind the barrier rows of some robots' QPs.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            obstacles: (N, M, COLUMNS).
            rows: (n,) which robots.
            nearest: (n,) the obstacle that refuses each one's reference.
            reference: (n, 2) of the QPs.
            side: (n,) the remembered side: 1, -1 or 0; overwritten by the new one.
            G: (n, m, 2) and what follows: as `linearise` left them.
            h: (n, m).
            count: (n,) how many barrier rows there are; not changed.
        """
        if not sources:
            return
        config = settings[0]
        for j in range(len(rows)):
            k = rows[j]
            way = circulate(config, obstacles[k, nearest[j]], _state(seen[k]), reference[j], side[j])
            side[j] = way[0]
            G[j, count[j], 0] = 0.0
            G[j, count[j], 1] = -1.0 if way[1] >= 0.0 else 1.0
            h[j, count[j]] = -abs(way[1])

    return add_circulation


def _search_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def search(
        settings: Records,
        seen: Records,
        obstacles: FloatArray,
        rows: IntArray,
        wanted: FloatArray,
        need: FloatArray,
        action: FloatArray,
        certificates: Records,
    ) -> None:
        """Find, for some robots, the certified action nearest to one on a grid, in the QP's norm.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            obstacles: (N, M, COLUMNS).
            rows: (n,) which robots.
            wanted: (n, 2) in the QP's variables.
            need: (N,) the clearance that certifies each [m].
            action: (n, 2) receives u1, u2.
            certificates: (N,) of `CERTIFICATE`, receives theirs; a clearance below 0 if there is none.
        """
        if not sources:
            return
        config = settings[0]
        limit = config.robot.force_limit
        for j in range(len(rows)):
            k = rows[j]
            state = _state(seen[k])
            count = seen[k].count
            best = FAR
            one = certificates[k]
            one.clearance = -FAR
            now = stopping(config.robot, state)
            stands = math.hypot(now.zx, now.zy) <= 0.3 * config.slow
            enough = FAR if stands else need[k]
            for i in range(_GRID * _GRID):
                f = 1.0 - 2.0 * (i // _GRID) / (_GRID - 1)
                w = 1.0 - 2.0 * (i % _GRID) / (_GRID - 1)
                cost = config.thrust_weight * (f - wanted[j, 0]) ** 2 + (w - wanted[j, 1]) ** 2
                if cost >= best and not stands:
                    continue
                found = certify_one(config, obstacles[k], count, state, f * limit, w, enough)
                if stands:
                    cost = -found[0]
                if found[0] >= need[k] and cost < best:
                    best = cost
                    one.clearance, one.nearest, one.backup, one.steps = found
                    action[j, 0] = f * limit
                    action[j, 1] = w

    return search


COMMITTED, UNKEPT, INSIDE = 0, 1, 2
"""What `recover` finds: a backup that keeps the inner margin; one that does not; a robot inside a hazard."""


def _recover_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def recover(
        settings: Records,
        seen: Records,
        obstacles: FloatArray,
        rows: IntArray,
        edge: FloatArray,
        action: FloatArray,
        certificates: Records,
        found: NDArray[np.int8],
    ) -> None:
        """Find, for some robots, the action that leaves the most clearance, or the way out of a hazard.

        What the model errs by, and the sensors, is kept whatever happens; the rest of the margin is not. A
        robot that stands nearer than that may go wherever it comes no nearer.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            obstacles: (N, M, COLUMNS).
            rows: (n,) which robots.
            edge: (n,) distance to the nearest hazard's edge [m].
            action: (n, 2) receives u1, u2.
            certificates: (N,) of `CERTIFICATE`, receives the backups.
            found: (n,) receives `COMMITTED`, `UNKEPT` or `INSIDE`.
        """
        if not sources:
            return
        config = settings[0]
        for j in range(len(rows)):
            k = rows[j]
            state = _state(seen[k])
            near = obstacles[k]
            count = seen[k].count
            here, _ = least_gap(near, count, 0.0, 0.0, 0.0, 0.0, -1, -FAR)
            one = certificates[k]
            if edge[j] < 0.0:
                action[j, 0], action[j, 1] = drive_out(config, near, count, state)
                found[j] = INSIDE
                continue
            least = min(config.sure - config.margin, 0.0)
            now = stopping(config.robot, state)
            if math.hypot(now.zx, now.zy) <= config.slow:
                least = min(least, here)
            thrust, turn, kept, one.backup, one.steps = commit(config, near, count, state, least)
            action[j, 0] = thrust
            action[j, 1] = turn
            found[j] = COMMITTED if kept else UNKEPT

    return recover


def _plan_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def keep_plans(
        settings: Records,
        seen: Records,
        rows: IntArray,
        action: FloatArray,
        certificates: Records,
        left: NDArray[np.int8],
        plan: FloatArray,
    ) -> None:
        """Write down, action by action, the backups that some robots' certificates end in.

        Args:
            settings: (1,) of `SETTINGS`.
            seen: (N,) of `SEEN`.
            rows: (n,) which robots.
            action: (N, 2) what is sent, after which the backup starts.
            certificates: (N,) of `CERTIFICATE`.
            left: (N,) receives how many actions a plan has.
            plan: (N, PLAN_STEPS, 2) receives them.
        """
        if not sources:
            return
        config = settings[0]
        robot = config.robot
        for k in rows:
            kind, steps = certificates[k].backup, certificates[k].steps
            left[k] = steps
            after = advance(robot, _state(seen[k]), action[k, 0], action[k, 1], robot.substeps)
            at = stopping(robot, after)
            for step in range(PLAN_STEPS):
                thrust, turn = 0.0, 0.0
                if step < steps:
                    thrust, turn = law(config.robot, kind, at)
                    at = follow(robot, at, thrust, turn)
                plan[k, step, 0] = thrust * robot.force_limit
                plan[k, step, 1] = turn

    return keep_plans


see = _see_entry()
certify = _certify_entry()
linearise = _linearise_entry()
add_circulation = _circulation_entry()
search = _search_entry()
recover = _recover_entry()
keep_plans = _plan_entry()
