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
from filter.circulation import SIDE_STEPS, circulate
from filter.config import Settings
from filter.qp import after, barrier_rows
from filter.recovery import commit, drive_out
from filter.solvers import solve_planar
from pointgoal.observation import LIDAR_RANGE
from system.backups import law, write_plan
from system.certificate import CERTIFICATE
from system.certificate import certify as certify_one
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
PASSED, LED, BARRIER, CIRCULATION, HOPELESS, OPEN = 0, 1, 2, 3, 4, 5
"""What `settle` comes to: the action passes as it is; the guide's is certified; the QP's is, by its barrier
rows alone, or with the circulation row; none can be; none is so far."""
LINEARISATIONS = (0.0, 0.0, 2.0, 0.0, 0.5, 0.1, 0.02)
"""How the QP is linearised, one after the other, until its solution is certified. 0: about the reference
first, about the last solution afterwards. Above 0: about the best backup's own action, which is feasible, and
the solution stays so near to it (2 leaves the whole box): a step is not smooth in the turn, whose servo
chatters, so that a linearisation may hold nearby only."""
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
            asked = nominal[k], config.hysteresis
            certified[k] = certify(settings, seen, obstacles, k, *asked, certificates)
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
def needed(settings: Records, seen: Records, k: int) -> float:
    """Clearance [m] that certifies what the filter puts in place of robot k's action, which was refused.

    It is 0, or what there is, if that is a little less: a robot that has lost a millimetre of its margin may
    keep what it has. A robot that is off needs the margin for what it may lose in a step.
    """
    config, robot = settings[0], settings[0].robot
    way = robot.gear * robot.force_limit / robot.drag * robot.physics_step * robot.substeps
    inner = max(0.5 * (config.margin - config.sure) - config.travel_error * way, 0.0)
    return float(min(max(seen[k].now.clearance, -inner), 0.0))


@entry
def certify(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    k: int,
    action: FloatArray,
    least: float,
    certificates: Records,
) -> bool:
    """Whether an ``action`` (2,) of robot k has a certificate that keeps a clearance ``least`` [m].

    A clearance at or above ``least`` says no more than that, one below only that it is below.
    """
    near, state, one = obstacles[k], _state(seen[k]), certificates[k]
    found = certify_one(settings[0], near, seen[k].count, state, action[0], action[1], least)
    one.clearance, one.nearest, one.backup, one.steps = found
    return bool(found[0] >= least)


@entry
def write_problem(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    k: int,
    nearest: int,
    trust: float,
    reference: FloatArray,
    asked: bool,
    memory: Records,
    about: FloatArray,
    G: FloatArray,
    h: FloatArray,
) -> int:
    """Write the barrier rows of robot k's QP to ``G`` (m, 2) and ``h`` (m,); how many there are.

    They are linearised about ``about`` (2,), in the QP's variables, for the best backup after that. With a
    ``trust`` above 0, it is the best backup from here that counts: its own action is written to ``about``,
    the rows are those of what is left of it, and four more keep the solution as near to that action.

    If the circulation row is ``asked`` for, it stands behind them: ``nearest`` is the obstacle that refuses
    the ``reference`` (2,) of the QP, and the side in ``memory`` (N,) becomes the new one.
    """
    config, one, near, state = settings[0], seen[k], obstacles[k], _state(seen[k])
    now, work, at = np.empty(len(h)), np.empty((3, len(h))), stopping(config.robot, state)
    clearances(config, one.now.backup, one.now.steps, near, one.count, at, now)
    if trust > 0.0:
        about[0], about[1] = law(config.robot, one.now.backup, at) if one.now.steps > 0 else (0.0, 0.0)
        backup = (one.now.backup, max(one.now.steps - 1, 0))
        end = after(config, state, about[0], about[1])
        clearances(config, backup[0], backup[1], near, one.count, end, work[0])
        for i in range(one.count):
            now[i] = min(now[i], work[0, i])
    else:
        end = after(config, state, about[0], about[1])
        found = best_backup(config, near, one.count, end, FAR, False)
        backup = (found[2], found[3])
    rows = barrier_rows(config, near, one.count, state, now, about, backup, G, h, work)
    if 0.0 < trust < 2.0:
        for i in range(4):
            sign = 1.0 - 2.0 * (i % 2)
            G[rows, 0], G[rows, 1] = (sign, 0.0) if i < 2 else (0.0, sign)
            h[rows] = sign * about[i // 2] + trust
            rows += 1
    if asked:
        side = (memory[k].side > 0) - (memory[k].side < 0)
        side, turn = circulate(config, near[nearest], state, reference, side)
        memory[k].side = side * SIDE_STEPS
        G[rows, 0], G[rows, 1], h[rows] = 0.0, -1.0 if turn >= 0.0 else 1.0, -abs(turn)
    return rows


@compiled
def _reference(limit: float, action: FloatArray) -> tuple[float, float]:
    """An action (2,) in the QP's variables, ``limit`` the largest u1."""
    return min(max(action[0] / limit, -1.0), 1.0), min(max(action[1], -1.0), 1.0)


@compiled
def _by_qp(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    k: int,
    circulating: bool,
    memory: Records,
    action: FloatArray,
    certificates: Records,
) -> int:
    """`BARRIER` or `CIRCULATION`, and the ``action`` (2,), if the QP's solution is certified; or `OPEN`."""
    config, most = settings[0], obstacles.shape[1] + 5
    limit, least = config.robot.force_limit, needed(settings, seen, k)
    nearest, weights = max(certificates[k].nearest, 0), np.array((config.thrust_weight, 1.0))
    x, about, found, G, h = np.empty(2), np.empty(2), np.empty(2), np.empty((most, 2)), np.empty(most)
    x[0], x[1] = _reference(limit, action)
    reference = x.copy()
    for trust in LINEARISATIONS:
        about[:] = x
        asked = nearest, trust, reference, circulating, memory
        rows = write_problem(settings, seen, obstacles, k, *asked, about, G, h)
        circled = circulating and solve_planar(weights, reference, G, h, rows + 1, x)
        if not (circled or solve_planar(weights, reference, G, h, rows, x)):
            continue
        found[0], found[1] = x[0] * limit, x[1]
        if certify(settings, seen, obstacles, k, found, least, certificates):
            action[:] = found
            return CIRCULATION if circled else BARRIER
    return OPEN


@entry
def settle(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    source: IntArray,
    active: BoolArray,
    certified: BoolArray,
    led: BoolArray,
    own: bool,
    action: FloatArray,
    hazard: IntArray,
    certificates: Records,
    memory: Records,
    outcome: NDArray[np.int8],
) -> int:
    """Decide about the robots that are ``led`` (N,) and those whose action has no certificate; how many stay.

    ``source`` (N, M) is each obstacle's hazard, or n + its bin; ``active`` (N,) whose action may be changed;
    ``certified`` (N,) whose nominal one has a certificate; ``led`` (N,) whose ``action`` (N, 2) is the
    guide's, and the others' are the nominal ones. It becomes what is sent, ``certificates`` those of it, and
    ``memory`` (N,) receives the plans that they end in; ``hazard`` (N,) receives what refuses an action, and
    ``outcome`` (N,) what this comes to: `PASSED`, `LED`, `BARRIER`, `CIRCULATION`, `HOPELESS` or `OPEN`.
    Without our ``own`` solver nothing is done about those that are `OPEN`.
    """
    left = 0
    for k in range(len(seen)):
        outcome[k] = PASSED
        if not active[k] or (certified[k] and not led[k]):
            continue
        robot = settings, seen, obstacles, k
        if led[k] and certify(*robot, action[k], settings[0].hysteresis, certificates):
            outcome[k] = LED
        else:
            nearest = certificates[k].nearest
            hazard[k] = source[k, nearest] if nearest >= 0 else -1
            # Where the best backup keeps less than any certificate needs, there is none to be found.
            outcome[k] = OPEN if seen[k].now.clearance >= needed(settings, seen, k) else HOPELESS
            if own and outcome[k] == OPEN:
                circulating = settings[0].circulation > 0.0 and not led[k]
                outcome[k] = _by_qp(*robot, circulating, memory, action[k], certificates)
        if outcome[k] == OPEN or outcome[k] == HOPELESS:
            left += 1
        else:
            _keep_plan(settings[0], seen[k], action[k], certificates[k], memory[k])
    return left


@entry
def search(
    settings: Records,
    seen: Records,
    obstacles: FloatArray,
    rows: IntArray,
    action: FloatArray,
    certificates: Records,
    done: BoolArray,
) -> None:
    """Find on a grid the certified ``action`` (n, 2) nearest to what it is, in the QP's norm.

    For a robot that stands, it is the one that leaves the most clearance: the nearest might be to stay.
    ``done`` (n,) receives whether there is one; where there is none, ``action`` stays.
    """
    config = settings[0]
    limit = config.robot.force_limit
    for j in range(len(rows)):
        k = rows[j]
        state, one = _state(seen[k]), certificates[k]
        now = stopping(config.robot, state)
        stands = math.hypot(now.zx, now.zy) <= _STANDS
        need = needed(settings, seen, k)
        enough = FAR if stands else need
        wanted = _reference(limit, action[j])
        best = FAR
        done[j] = False
        for i in range(_GRID * _GRID):
            f = 1.0 - 2.0 * (i // _GRID) / (_GRID - 1)
            w = 1.0 - 2.0 * (i % _GRID) / (_GRID - 1)
            cost = config.thrust_weight * (f - wanted[0]) ** 2 + (w - wanted[1]) ** 2
            if cost >= best and not stands:
                continue
            found = certify_one(config, obstacles[k], seen[k].count, state, f * limit, w, enough)
            if stands:
                cost = -found[0]
            if found[0] >= need and cost < best:
                best, done[j] = cost, True
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


@compiled
def _keep_plan(
    config: Settings, seen: Settings, action: FloatArray, certificate: Settings, past: Settings
) -> None:
    """Write down that an action (2,) is sent, and the backup of its certificate from where it leads."""
    past.planned, past.left = True, certificate.steps
    past.history.sent[0, 0], past.history.sent[0, 1] = action[0], action[1]
    plan = certificate.backup, certificate.steps, past.plan
    write_plan(config.robot, _state(seen), action[0], action[1], *plan)


@entry
def keep_plans(
    settings: Records,
    seen: Records,
    which: BoolArray,
    action: FloatArray,
    certificates: Records,
    memory: Records,
) -> None:
    """Write down what is sent, ``action`` (N, 2), to ``memory`` (N,), and the plans of some robots (N,)."""
    for k in range(len(which)):
        if which[k]:
            _keep_plan(settings[0], seen[k], action[k], certificates[k], memory[k])
        else:
            memory[k].history.sent[0, 0], memory[k].history.sent[0, 1] = action[k]
