"""What the sensors should show, by what they showed before and what the robot was sent since.

The robot's exact model tells from one observation what velocimeter, gyro and magnetometer show in the next
one, and where a thing has moved to that a lidar shows by itself. A sensor that is dead, frozen, negated,
noisy or late shows something else as soon as the robot moves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from decision import MOST_LATE
from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, layout
from system.compiled import compiled, entry
from system.lidar import place_alone
from system.point_robot import ROBOT, Robot, State, once_arrived
from system.surroundings import in_own_frame

FloatArray = NDArray[np.float64]
Readings = NDArray[np.floating[Any]]

GROUPS = tuple(block.name for block in layout(1).blocks)
"""The sensors, in the observation's order."""
STEERED_BY = np.array([name in ("velocimeter", "gyro", "hazards_lidar") for name in GROUPS])
"""Which of them the filter relies on."""
_ACCELEROMETER, _VELOCIMETER, _GYRO, _MAGNETOMETER, _LIDARS = (
    layout(1).slice(name).start
    for name in ("accelerometer", "velocimeter", "gyro", "magnetometer", "goal_lidar")
)
_GRAVITY = 9.81
_ALONE = 3e-4
"""How much the two readings beside a bin may differ from its own, together, for a thing alone in it."""
_FAR = 0.2
"""Weakest reading by which a thing is followed: 2.4 m."""
_NEAR = (0.4, 0.0, 0.4)
"""Goals and vases nearer than this may be met, or moved [m]; hazards stay where they are."""
NEVER = 1e9
"""A distance beyond every limit."""
OFF, FROZEN, SURPRISE = 0, 1, 2
"""The kinds of distances of a sensor: from what physics says; by how much its numbers should have changed, if
they are to the last bit what they were; from what the other sensors let expect."""


@compiled
def _alone(readings: Readings, b: int) -> tuple[bool, float, float]:
    """Whether bin b shows one thing and nothing else, and where that is [m]."""
    reading = np.float64(readings[b])
    before, after = readings[(b + LIDAR_BINS - 1) % LIDAR_BINS], readings[(b + 1) % LIDAR_BINS]
    if reading <= 0.0 or reading > 1.0 or abs(before + after - reading) > _ALONE:
        return False, 0.0, 0.0
    x, y = place_alone(readings, b)
    return True, x, y


@compiled
def _misplaced(
    before: Readings, now: Readings, b: int, at: State, turn: tuple[float, float], near: float
) -> float:
    """How far the thing alone in bin b of a scan (16,) is from where the next one shows it [m]."""
    alone, x, y = _alone(before, b)
    if not alone:
        return 0.0
    # As `in_own_frame` does, with the heading's cosine and sine at hand.
    dx, dy = x - at.x, y - at.y
    px, py = turn[0] * dx + turn[1] * dy, turn[0] * dy - turn[1] * dx
    away = math.sqrt(px * px + py * py)
    shown = 1.0 - away / LIDAR_RANGE
    if away < near or shown < _FAR:
        return 0.0
    place = math.floor(math.atan2(py, px) / BIN_WIDTH) + LIDAR_BINS
    miss, beside, there = NEVER, 0.0, False
    for i in range(place - 1, place + 2):
        bin = i % LIDAR_BINS
        beside = max(beside, np.float64(now[bin]))
        seen, qx, qy = _alone(now, bin)
        there |= seen and i == place
        if seen:
            miss = min(miss, math.sqrt((qx - px) * (qx - px) + (qy - py) * (qy - py)))
    if beside > shown + _ALONE or not there:
        # Others are in the way of telling where it is; but it must show.
        return max(LIDAR_RANGE * (shown - beside), 0.0)
    return miss


@compiled
def _lidar(
    before: Readings, now: Readings, most: float, weakest: float, at: State, near: float
) -> tuple[float, float]:
    """By how much a lidar (16,) shows other things than it should [m], and how far the robot moved past them.

    ``most`` and ``weakest`` are its readings now; ``at`` is where the robot is now, from where it was; things
    nearer than ``near`` [m] are not looked at.
    """
    moved = math.hypot(at.x, at.y)
    was = np.float64(before.max())
    off = max(0.0, -LIDAR_RANGE * weakest, LIDAR_RANGE * (most - 1.0))
    past = moved if was > 0.0 else 0.0
    if LIDAR_RANGE * (1.0 - max(was, most)) < near:
        return off, past
    if was > 0.0 and was < 1.0:
        # The nearest thing comes no nearer, and goes no further, than the robot moves; out of sight it is 0.
        off = max(off, LIDAR_RANGE * abs(most - was) - moved if most > 0.0 else LIDAR_RANGE * was - moved)
    turn = math.cos(at.heading), math.sin(at.heading)
    for b in range(LIDAR_BINS):
        off = max(off, _misplaced(before, now, b, at, turn, near))
    return off, past


@compiled
def _same(before: Readings, now: Readings) -> bool:
    same = True
    for i in range(len(before)):
        same &= before[i] == np.float32(now[i])
    return same


@compiled
def _acceleration(robot: Robot, vx: float, yaw_rate: float, u1: float) -> float:
    """What the accelerometer shows ahead [m/s^2]: along the heading nothing else has an effect."""
    force = robot.gear * min(max(u1, -robot.force_limit), robot.force_limit)
    k = robot.mass * robot.offset
    ahead: float = (force + k * yaw_rate * yaw_rate - robot.drag * vx) / robot.mass
    return ahead


@compiled
def _numbers(seen: FloatArray, numbers: FloatArray) -> None:
    """What is compared with what a policy has seen: an observation, and per sensor what bounds it."""
    size = len(seen)
    numbers[:size] = seen
    for sensor in range(4):
        x, y, z = seen[3 * sensor], seen[3 * sensor + 1], seen[3 * sensor + 2]
        numbers[size + sensor] = math.sqrt(x * x + y * y + z * z)
    for lidar in range((size - _LIDARS) // LIDAR_BINS):
        readings = seen[_LIDARS + lidar * LIDAR_BINS : _LIDARS + (lidar + 1) * LIDAR_BINS]
        place = size + 4 + 3 * lidar
        numbers[place] = readings.sum()
        numbers[place + 1] = readings.max()
        numbers[place + 2] = readings.min()


def count_of_numbers(observation_size: int) -> int:
    """How many numbers `numbers_of` makes of an observation."""
    lidars = (observation_size - int(_LIDARS)) // LIDAR_BINS
    return observation_size + 4 + 3 * lidars


def groups_of_numbers(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers, sensor by sensor (m,), and where in that order each of 7 sensors begins, and the end."""
    size = next(o for o in (layout(0).size, layout(1).size) if count_of_numbers(o) == count)
    order: list[int] = []
    bounds = [0]
    for sensor in range(4 + (size - _LIDARS) // LIDAR_BINS):
        if sensor < 4:
            order += [*range(3 * sensor, 3 * sensor + 3), size + sensor]
        else:
            first, more = _LIDARS + (sensor - 4) * LIDAR_BINS, size + 4 + 3 * (sensor - 4)
            order += [*range(first, first + LIDAR_BINS), *range(more, more + 3)]
        bounds.append(len(order))
    bounds += [len(order)] * (len(GROUPS) + 1 - len(bounds))
    return np.array(order), np.array(bounds)


@entry
def numbers_of(observation: FloatArray, numbers: FloatArray) -> None:
    """The numbers (N, m) of observations (N, O) that are compared with what a policy has seen."""
    for k in range(len(observation)):
        _numbers(observation[k], numbers[k])


@compiled
def _compare(known: Any, now: FloatArray, numbers: FloatArray, past: Any, off: FloatArray) -> None:
    """How far each sensor is from what it should show, 0 where nothing is known.

    Args:
        known: one of `tables_for`.
        now: (60,) or (28,) the observation.
        numbers: those that `numbers_of` makes of it.
        past: one of `HISTORY`, before this step.
        off: (3, 7) receives the kinds `OFF` and `FROZEN`, in m/s^2, m/s, rad/s, 1, and m for the lidars;
            `NEVER` for an empty one.
    """
    off[:SURPRISE] = 0.0
    physics, frozen = off[OFF], off[FROZEN]
    extremes = len(now) + 4
    lidars = (len(now) - _LIDARS) // LIDAR_BINS
    for lidar in range(lidars):
        if numbers[extremes + 3 * lidar + 1] < known.least[lidar]:
            physics[4 + lidar] = NEVER
    robot, delay = known.robot, known.delay
    if past.age < 1 or delay + past.age > MOST_LATE + 1:
        return
    before, sent = past.sensed, past.sent
    vx, vy = np.float64(before[_VELOCIMETER]), np.float64(before[_VELOCIMETER + 1])
    start = State(0.0, 0.0, 0.0, vx, vy, np.float64(before[_GYRO + 2]))
    at = once_arrived(robot, start, sent[delay:], past.age)
    ahead, aside = in_own_frame(at.x + at.vx, at.y + at.vy, at)
    mx, my = in_own_frame(at.x + before[_MAGNETOMETER], at.y + before[_MAGNETOMETER + 1], at)
    pushed = _acceleration(robot, ahead, at.yaw_rate, sent[delay, 0])
    physics[0] = max(abs(now[_ACCELEROMETER] - pushed), abs(now[_ACCELEROMETER + 2] - _GRAVITY))
    physics[1] = max(abs(now[_VELOCIMETER] - ahead), abs(now[_VELOCIMETER + 1] - aside))
    physics[2] = abs(now[_GYRO + 2] - at.yaw_rate)
    physics[3] = max(abs(now[_MAGNETOMETER] - mx), abs(now[_MAGNETOMETER + 1] - my))
    for sensor in range(4):
        i = 3 * sensor
        if _same(before[i : i + 3], now[i : i + 3]):
            frozen[sensor] = physics[sensor]
    for lidar in range(lidars):
        i, j = _LIDARS + lidar * LIDAR_BINS, extremes + 3 * lidar
        old, new = before[i : i + LIDAR_BINS], now[i : i + LIDAR_BINS]
        miss, moved = _lidar(old, new, numbers[j + 1], numbers[j + 2], at, _NEAR[lidar])
        physics[4 + lidar] = max(physics[4 + lidar], miss)
        if _same(old, new):
            frozen[4 + lidar] = moved


@compiled
def _surprise(known: Any, numbers: FloatArray, apart: FloatArray, off: FloatArray) -> None:
    """How far each sensor is from what the others let expect: squared Mahalanobis distances, conditional.

    With the precision P of all numbers and d their distances from the mean, that of a sensor whose numbers
    are g is (P d)_g' (P_gg)^-1 (P d)_g. With P_gg = L L' that is the square of the length of L^-1 (P d)_g:
    one product of a matrix with d for all sensors, whose columns stand in ``known.apart``.

    Args:
        known: one of `tables_for`.
        numbers: (m,) those that `numbers_of` makes of the observation.
        apart: (m,) for what is computed on the way.
        off: (7,) receives them.
    """
    m = len(numbers)
    apart[:] = 0.0
    for j in range(m):
        distance = numbers[j] - known.mean[j]
        for i in range(m):
            apart[i] += known.apart[j, i] * distance
    for sensor in range(len(off)):
        total = 0.0
        for i in range(known.bounds[sensor], known.bounds[sensor + 1]):
            total += apart[i] * apart[i]
        off[sensor] = total


@compiled
def _weigh(limits: FloatArray, one: Any) -> bool:
    """Find the largest of the distances in one of `FOUND` in parts of their ``limits`` (3, 7).

    Returns whether it is above 1, or a sensor that the filter steers by is not trusted, now or still.
    """
    novelty, suspect, doubted = 0.0, 0, one.doubted
    for kind in range(len(limits)):
        for sensor in range(len(limits[0])):
            parts = one.off[kind, sensor] / limits[kind, sensor]
            doubted |= kind != SURPRISE and parts > 1.0 and STEERED_BY[sensor]
            if parts > novelty:
                novelty, suspect = parts, sensor
    one.novelty, one.suspect, one.doubted = novelty, suspect, doubted
    return bool(doubted or novelty > 1.0)


def tables_for(m: int) -> np.dtype[np.void]:
    """What `look` knows of a robot and of what is normal, where so many numbers are compared.

    - ``robot``: `ROBOT`; ``delay``: control steps until an action takes effect.
    - ``least``: the strongest reading that a scan of each lidar shows at least.
    - ``limits``: of each sensor's distances, kind by kind.
    - ``mean``: of the numbers; ``apart``, ``bounds``: see `_surprise`; where each sensor's rows begin.
    """
    shapes = {"least": (3,), "limits": (3, len(GROUPS)), "mean": (m,), "apart": (m, m)}
    numbers = [(name, "f8", shape) for name, shape in shapes.items()]
    return np.dtype(
        [("robot", ROBOT), ("delay", "i8"), *numbers, ("bounds", "i8", (len(GROUPS) + 1,))], align=True
    )


FOUND = np.dtype(
    [("off", "f8", (3, len(GROUPS))), ("novelty", "f8"), ("suspect", "i8"), ("doubted", "?")], align=True
)
"""What is found in one observation.

- ``off``: each sensor's distances, kind by kind.
- ``novelty``: the largest of them in parts of its limit; ``suspect``: whose it is.
- ``doubted``: whether a sensor that the filter steers by is not trusted, now or still.
"""


@entry
def look(
    tables: NDArray[np.void], observation: FloatArray, memory: NDArray[np.void], found: NDArray[np.void]
) -> bool:
    """Look at N observations (N, O); ``found`` (N,) of `FOUND` receives what they come to.

    ``tables`` is (1,) of `tables_for`, ``memory`` (N,) of `MEMORY`, before this step. Returns whether any
    novelty is above 1, or a sensor not trusted.
    """
    known = tables[0]
    numbers, apart = np.empty(len(known.mean)), np.empty(len(known.mean))
    any_of_them = False
    for k in range(len(observation)):
        one, past = found[k], memory[k].history
        _numbers(observation[k], numbers)
        _compare(known, observation[k], numbers, past, one.off)
        _surprise(known, numbers, apart, one.off[SURPRISE])
        one.doubted = past.doubted > 0
        any_of_them |= _weigh(known.limits, one)
    return any_of_them


@entry
def remember(observation: FloatArray, found: NDArray[np.void], memory: NDArray[np.void]) -> None:
    """Write down what was seen (N, O), and who is not trusted any more, in N robots' memory."""
    for k in range(len(observation)):
        past = memory[k].history
        past.age = 1
        past.doubted = found[k].doubted
        for i in range(observation.shape[1]):
            past.sensed[i] = observation[k, i]
