"""The numbers of a step, robot by robot in compiled loops; `barrier_filter` says what is done with them.

All take ``settings`` (1,) of `SETTINGS` and arrays with a row for each of N robots: ``seen`` (N,) of `SEEN`,
``obstacles`` (N, M, COLUMNS), ``certificates`` (N,) of `CERTIFICATE`. Where only n robots are meant, ``rows``
(n,) says which; ``action`` (n, 2) is u1, u2, and what else has n rows belongs to them as well.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from decision import MOST_LATE
from filter.certificate import CERTIFICATE
from filter.certificate import certify as certify_one
from filter.circulation import SIDE_STEPS, circulate
from filter.config import Settings
from filter.qp import after, barrier_rows
from filter.recovery import commit, drive_out
from pointgoal.observation import LIDAR_RANGE
from system.backups import law, write_plan
from system.clearance import best_backup, clearances
from system.compiled import compiled, entry
from system.lidar import contradictory
from system.obstacles import FAR, least_gap
from system.point_robot import State, once_arrived, stopping
from system.surroundings import in_own_frame, surroundings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Records = NDArray[np.void]

SEEN = np.dtype(
    [
        ("x", "f8"),
        ("y", "f8"),
        ("heading", "f8"),
        ("vx", "f8"),
        ("vy", "f8"),
        ("yaw_rate", "f8"),
        ("count", "i8"),
        ("now", CERTIFICATE),
        ("sure", CERTIFICATE),
    ],
    align=True,
)
"""One robot when its next action takes effect, as the filter sees it: where that is, from where it was seen
[m, rad]; its velocity ahead and to the left [m/s], its yaw rate [rad/s]; how many obstacles are within reach;
its best backup from there, whose clearance is the barrier; one that keeps 0 after any one action, if any."""
COMMITTED, UNKEPT, INSIDE = 0, 1, 2
"""What `recover` finds: a backup that keeps the inner margin; one that does not; a robot inside a hazard."""
_GRID = 5
"""Thrusts, and turns, that the search tries."""
_LARGEST = float(np.finfo(np.float32).max)
_SCAN = 1e-3
"""Contradiction between three readings that is let pass beside their errors: 3 mm."""
_STANDS = 0.03
"""Way to the stop point up to which a robot stands [m]: 6 cm/s."""


@compiled
def _state(seen: Settings) -> State:
    """The state of one row of `SEEN`, in the frame of the decision."""
    return State(0.0, 0.0, 0.0, seen.vx, seen.vy, seen.yaw_rate)


@entry
def see(
    settings: Records,
    observation: FloatArray,
    columns: tuple[int, int, int, int, int],
    given: FloatArray,
    memory: Records,
    seen: Records,
    obstacles: FloatArray,
    source: IntArray,
) -> int:
    """Find all robots' obstacles and backups; the last three arguments receive them.

    ``columns`` tells where in an ``observation`` (N, O) the velocity ahead, followed by that to the left,
    and the yaw rate stand, where the hazards' lidar starts and ends, and where the goal's starts. ``given``
    (N, n, 2) are hazards [m]; what is under way stands in ``memory`` (N,); ``source`` (N, M) receives each
    obstacle's hazard, or n + its bin. Returns the place of the first number of all observations that float32
    cannot hold, -1 if there is none. A robot whose scan contradicts itself has a barrier of NaN.
    """
    config = settings[0]
    velocity, yaw, first, last, _ = columns
    for k in range(observation.shape[0]):
        for i in range(observation.shape[1]):
            if not abs(observation[k, i]) <= _LARGEST:
                return int(k * observation.shape[1] + i)
        one = seen[k]
        vx, vy = observation[k, velocity], observation[k, velocity + 1]
        coming = State(0.0, 0.0, 0.0, vx, vy, observation[k, yaw])
        one.x, one.y, one.heading, one.vx, one.vy, one.yaw_rate = coming
        if config.delay_steps > 0:
            coming = once_arrived(config.robot, coming, memory[k].history.sent, config.delay_steps)
            one.x, one.y, one.heading, _, _, one.yaw_rate = coming
            one.vx, one.vy = in_own_frame(coming.x + coming.vx, coming.y + coming.vy, coming)
        readings = observation[k, first:last]
        if contradictory(readings, _SCAN + 3.0 * config.position_error / LIDAR_RANGE):
            one.count = 0
            one.now.clearance, one.now.nearest, one.now.backup, one.now.steps = math.nan, -1, 0, 0
            one.sure.clearance, one.sure.nearest, one.sure.backup, one.sure.steps = -FAR, -1, 0, 0
            continue
        one.count = surroundings(config, coming, given[k], readings, obstacles[k], source[k])
        at = stopping(config.robot, _state(one))
        now = best_backup(config, obstacles[k], one.count, at, FAR, False)
        one.now.clearance = min(now[0], LIDAR_RANGE)
        one.now.nearest, one.now.backup, one.now.steps = now[1:]
        sure = best_backup(config, obstacles[k], one.count, at, 0.0, True)
        one.sure.clearance, one.sure.nearest, one.sure.backup, one.sure.steps = sure
    return -1


@entry
def screen(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    nominal: FloatArray,
    active: BoolArray,
    certificates: Records,
    certified: BoolArray,
    before: Records,
    memory: Records,
) -> int:
    """Look for certificates of the nominal actions (N, 2) where the gate is open; how many have none.

    Where ``active`` (N,) is False, the sure backup stands for one. ``certified`` (N,) receives which have
    one, ``memory`` (N,) what it was ``before``: but a side fades, plans and actions are written down.
    """
    config = settings[0]
    refused = 0
    for k in range(len(seen)):
        one, state = certificates[k], _state(seen[k])
        u1, u2 = nominal[k]
        certified[k] = False
        if active[k]:
            found = certify_one(config, obstacles[k], seen[k].count, state, u1, u2, config.hysteresis)
            one.clearance, one.nearest, one.backup, one.steps = found
            certified[k] = found[0] >= config.hysteresis
            refused += not certified[k]
        else:
            sure = seen[k].sure
            one.clearance, one.nearest = sure.clearance, sure.nearest
            one.backup, one.steps = sure.backup, sure.steps
        memory[k] = before[k]
        past = memory[k]
        past.side -= (past.side > 0) - (past.side < 0)
        sent = past.history.sent
        for i in range(MOST_LATE, 0, -1):
            sent[i] = sent[i - 1]
        sent[0, 0], sent[0, 1] = u1, u2
        past.planned = certified[k] or (not active[k] and one.clearance >= 0.0)
        past.left = one.steps
        write_plan(config.robot, state, u1, u2, one.backup, one.steps, past.plan)
    return refused


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
    """Look for certificates that keep a clearance ``least`` (n,) [m].

    A clearance at or above ``least`` says no more than that, one below only that it is below.
    """
    config = settings[0]
    for j in range(len(rows)):
        k = rows[j]
        u1, u2 = action[j]
        found = certify_one(config, obstacles[k], seen[k].count, _state(seen[k]), u1, u2, least[j])
        one = certificates[k]
        one.clearance, one.nearest, one.backup, one.steps = found


@entry
def linearise(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    rows: IntArray,
    about: FloatArray,
    trust: float,
    G: FloatArray,
    h: FloatArray,
    count: IntArray,
) -> None:
    """Write the barrier rows of QPs to ``G`` (n, m, 2) and ``h`` (n, m), and how many to ``count`` (n,).

    They are linearised about ``about`` (n, 2), in the QP's variables, for the best backup after that. With a
    ``trust`` above 0, it is the best backup from here that counts: its own action is written to ``about``,
    the rows are those of what is left of it, and four more keep the solution as near to that action.
    """
    config = settings[0]
    now, work = np.empty(h.shape[1]), np.empty((3, h.shape[1]))
    for j in range(len(rows)):
        k = rows[j]
        one, near, state = seen[k], obstacles[k], _state(seen[k])
        at = stopping(config.robot, state)
        clearances(config, one.now.backup, one.now.steps, near, one.count, at, now)
        if trust > 0.0:
            about[j] = law(config.robot, one.now.backup, at) if one.now.steps > 0 else (0.0, 0.0)
            backup = (one.now.backup, max(one.now.steps - 1, 0))
            end = after(config, state, about[j, 0], about[j, 1])
            clearances(config, backup[0], backup[1], near, one.count, end, work[0])
            for i in range(one.count):
                now[i] = min(now[i], work[0, i])
        else:
            end = after(config, state, about[j, 0], about[j, 1])
            found = best_backup(config, near, one.count, end, FAR, False)
            backup = (found[2], found[3])
        count[j] = barrier_rows(config, near, one.count, state, now, about[j], backup, G[j], h[j], work)
        if 0.0 < trust < 2.0:
            for i in range(4):
                sign = 1.0 - 2.0 * (i % 2)
                G[j, count[j]] = (sign, 0.0) if i < 2 else (0.0, sign)
                h[j, count[j]] = sign * about[j, i // 2] + trust
                count[j] += 1


@entry
def add_circulation(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    rows: IntArray,
    nearest: IntArray,
    reference: FloatArray,
    asked: BoolArray,
    memory: Records,
    G: FloatArray,
    h: FloatArray,
    count: IntArray,
) -> None:
    """Write the circulation row behind the rows of QPs; ``count`` stays.

    ``nearest`` (n,) is the obstacle that refuses the ``reference`` (n, 2) of the QP. The side that is
    remembered in ``memory`` (N,) becomes the new one where the row is ``asked`` for (n,).
    """
    for j in range(len(rows)):
        k = rows[j]
        side = (memory[k].side > 0) - (memory[k].side < 0)
        way = circulate(settings[0], obstacles[k, nearest[j]], _state(seen[k]), reference[j], side)
        if asked[j]:
            memory[k].side = way[0] * SIDE_STEPS
        G[j, count[j]] = (0.0, -1.0 if way[1] >= 0.0 else 1.0)
        h[j, count[j]] = -abs(way[1])


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
    """Find on a grid the certified ``action`` nearest to ``wanted`` (n, 2) in the QP's norm.

    For a robot that stands, it is the one that leaves the most clearance: the nearest might be to stay.
    ``need`` (N,) is the clearance that certifies each; where none does, the certificate's is below.
    """
    config = settings[0]
    limit = config.robot.force_limit
    for j in range(len(rows)):
        k = rows[j]
        state, one = _state(seen[k]), certificates[k]
        now = stopping(config.robot, state)
        stands = math.hypot(now.zx, now.zy) <= _STANDS
        enough = FAR if stands else need[k]
        best = FAR
        one.clearance = -FAR
        for i in range(_GRID * _GRID):
            f = 1.0 - 2.0 * (i // _GRID) / (_GRID - 1)
            w = 1.0 - 2.0 * (i % _GRID) / (_GRID - 1)
            cost = config.thrust_weight * (f - wanted[j, 0]) ** 2 + (w - wanted[j, 1]) ** 2
            if cost >= best and not stands:
                continue
            found = certify_one(config, obstacles[k], seen[k].count, state, f * limit, w, enough)
            if stands:
                cost = -found[0]
            if found[0] >= need[k] and cost < best:
                best = cost
                one.clearance, one.nearest, one.backup, one.steps = found
                action[j] = (f * limit, w)


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
    """Find the ``action`` that leaves the most clearance, or the way out of a hazard.

    What the model errs by, and the sensors, is kept whatever happens; the rest of the margin is not. A robot
    that stands nearer than that may go wherever it comes no nearer. ``edge`` (n,) is the distance to the
    nearest hazard's edge [m]; ``found`` (n,) receives `COMMITTED`, `UNKEPT` or `INSIDE`.
    """
    config = settings[0]
    for j in range(len(rows)):
        k = rows[j]
        state, near, count = _state(seen[k]), obstacles[k], seen[k].count
        if edge[j] < 0.0:
            action[j] = drive_out(config, near, count, state)
            found[j] = INSIDE
            continue
        least = min(config.sure - config.margin, 0.0)
        now = stopping(config.robot, state)
        if math.hypot(now.zx, now.zy) <= config.slow:
            least = min(least, least_gap(near, count, 0.0, 0.0, 0.0, 0.0, -1, -FAR)[0])
        one = certificates[k]
        thrust, turn, kept, one.backup, one.steps = commit(config, near, count, state, least)
        action[j] = (thrust, turn)
        found[j] = COMMITTED if kept else UNKEPT


@entry
def keep_plans(
    settings: Records,
    seen: Records,
    which: BoolArray,
    action: FloatArray,
    certificates: Records,
    memory: Records,
) -> None:
    """Write the backups of the certificates, from where ``action`` (N, 2) leads, to ``memory`` (N,)."""
    for k in range(len(which)):
        if not which[k]:
            continue
        one, past = certificates[k], memory[k]
        past.planned = True
        past.left = one.steps
        u1, u2 = action[k]
        write_plan(settings[0].robot, _state(seen[k]), u1, u2, one.backup, one.steps, past.plan)
