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
from system.point_robot import Robot, State, once_arrived
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
def _misplaced(before: Readings, now: Readings, b: int, at: State, near: float) -> float:
    """How far the thing alone in bin b of a scan (16,) is from where the next one shows it [m]."""
    alone, x, y = _alone(before, b)
    if not alone:
        return 0.0
    px, py = in_own_frame(x, y, at)
    away = math.hypot(px, py)
    shown = 1.0 - away / LIDAR_RANGE
    if away < near or shown < _FAR:
        return 0.0
    place = math.floor(math.atan2(py, px) / BIN_WIDTH) + LIDAR_BINS
    miss, beside = NEVER, 0.0
    for i in range(place - 1, place + 2):
        bin = i % LIDAR_BINS
        beside = max(beside, np.float64(now[bin]))
        seen, qx, qy = _alone(now, bin)
        if seen:
            miss = min(miss, math.hypot(qx - px, qy - py))
    if beside > shown + _ALONE or not _alone(now, place % LIDAR_BINS)[0]:
        # Others are in the way of telling where it is; but it must show.
        return max(LIDAR_RANGE * (shown - beside), 0.0)
    return miss


@compiled
def _lidar(before: Readings, now: Readings, at: State, near: float) -> tuple[float, float]:
    """By how much a lidar (16,) shows other things than it should [m], and how far the robot moved past them.

    ``at`` is where the robot is now, from where it was; things nearer than ``near`` [m] are not looked at.
    """
    moved = math.hypot(at.x, at.y)
    was, most = np.float64(before.max()), np.float64(now.max())
    off = 0.0
    for i in range(LIDAR_BINS):
        off = max(off, -LIDAR_RANGE * now[i], LIDAR_RANGE * (now[i] - 1.0))
    past = moved if was > 0.0 else 0.0
    if LIDAR_RANGE * (1.0 - max(was, most)) < near:
        return off, past
    if was > 0.0 and was < 1.0:
        # The nearest thing comes no nearer, and goes no further, than the robot moves; out of sight it is 0.
        off = max(off, LIDAR_RANGE * abs(most - was) - moved if most > 0.0 else LIDAR_RANGE * was - moved)
    for b in range(LIDAR_BINS):
        off = max(off, _misplaced(before, now, b, at, near))
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
def compare(robot: Robot, delay: int, now: FloatArray, past: Any, least: FloatArray, off: FloatArray) -> None:
    """How far each sensor is from what it should show, 0 where nothing is known.

    Args:
        robot: the constants.
        delay: control steps until an action takes effect.
        now: (60,) or (28,) the observation.
        past: one of `HISTORY`, before this step.
        least: (3,) the strongest reading that a scan of each lidar shows at least.
        off: (3, 7) receives the kinds `OFF` and `FROZEN`, in m/s^2, m/s, rad/s, 1, and m for the lidars;
            `NEVER` for an empty one.
    """
    off[:SURPRISE] = 0.0
    physics, frozen = off[OFF], off[FROZEN]
    lidars = (len(now) - _LIDARS) // LIDAR_BINS
    for lidar in range(lidars):
        i = _LIDARS + lidar * LIDAR_BINS
        if now[i : i + LIDAR_BINS].max() < least[lidar]:
            physics[4 + lidar] = NEVER
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
        i = _LIDARS + lidar * LIDAR_BINS
        old, new = before[i : i + LIDAR_BINS], now[i : i + LIDAR_BINS]
        miss, moved = _lidar(old, new, at, _NEAR[lidar])
        physics[4 + lidar] = max(physics[4 + lidar], miss)
        if _same(old, new):
            frozen[4 + lidar] = moved


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
    """How many numbers `surprise` compares."""
    lidars = (observation_size - int(_LIDARS)) // LIDAR_BINS
    return observation_size + 4 + 3 * lidars


def groups_of_numbers(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers, sensor by sensor (m,), and where in that order each sensor begins, and the end."""
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
    return np.array(order), np.array(bounds)


@entry
def numbers_of(observation: FloatArray, numbers: FloatArray) -> None:
    """The numbers (N, m) of observations (N, O) that are compared with what a policy has seen."""
    for k in range(len(observation)):
        _numbers(observation[k], numbers[k])


@compiled
def surprise(now: FloatArray, normal: Any, off: FloatArray) -> None:
    """How far each sensor is from what the others let expect: squared Mahalanobis distances, conditional.

    With the precision P of all numbers and d their distances from the mean, that of a sensor whose numbers
    are g is (P d)_g' (P_gg)^-1 (P d)_g.

    Args:
        now: (O,) the observation.
        normal: mean (m,) of the numbers; precision (m, m); order (m,), the numbers sensor by sensor; bounds
            (8,) or less, where in the order each sensor begins, and the end; inverse (m, m) of the
            precision's blocks on the diagonal, in that order.
        off: (7,) receives them.
    """
    mean, precision, order, bounds, inverse = normal
    m = len(mean)
    numbers, pulled = np.empty(m), np.zeros(m)
    _numbers(now, numbers)
    for j in range(m):
        distance = numbers[j] - mean[j]
        for i in range(m):
            pulled[i] += precision[j, i] * distance
    off[:] = 0.0
    for sensor in range(len(bounds) - 1):
        total = 0.0
        for a in range(bounds[sensor], bounds[sensor + 1]):
            row = 0.0
            for b in range(bounds[sensor], bounds[sensor + 1]):
                row += inverse[a, b] * pulled[order[b]]
            total += row * pulled[order[a]]
        off[sensor] = total


@entry
def measure(
    robots: NDArray[np.void],
    delay: int,
    observation: FloatArray,
    memory: NDArray[np.void],
    least: FloatArray,
    normal: Any,
    off: FloatArray,
) -> None:
    """For N observations (N, O): `compare` and `surprise`; ``off`` (N, 3, 7) receives what they find.

    ``robots`` is (1,) of `ROBOT`, ``memory`` (N,) of `MEMORY`, before this step.
    """
    for k in range(len(observation)):
        compare(robots[0], delay, observation[k], memory[k].history, least, off[k])
        surprise(observation[k], normal, off[k, SURPRISE])


@entry
def weigh(
    off: FloatArray,
    limits: FloatArray,
    memory: NDArray[np.void],
    novelty: FloatArray,
    suspect: NDArray[np.int64],
    doubted: NDArray[np.bool_],
) -> bool:
    """Find the largest of the distances ``off`` (N, 3, 7) in parts of their ``limits`` (3, 7).

    Returns whether any is above 1, or a sensor is still not trusted.
    ``novelty`` (N,) receives it, ``suspect`` (N,) whose it is, and ``doubted`` (N,) whether a sensor that the
    filter steers by is not trusted, now or still.
    """
    any_of_them = False
    for k in range(len(off)):
        novelty[k], suspect[k] = 0.0, 0
        doubted[k] = memory[k].history.doubted > 0
        for kind in range(len(limits)):
            for sensor in range(len(limits[0])):
                parts = off[k, kind, sensor] / limits[kind, sensor]
                doubted[k] |= kind != SURPRISE and parts > 1.0 and STEERED_BY[sensor]
                if parts > novelty[k]:
                    novelty[k], suspect[k] = parts, sensor
        any_of_them |= doubted[k] or novelty[k] > 1.0
    return any_of_them


@entry
def remember(observation: FloatArray, doubted: NDArray[np.bool_], memory: NDArray[np.void]) -> None:
    """Write down what was seen (N, O), and who is not trusted any more (N,), in N robots' memory."""
    for k in range(len(observation)):
        past = memory[k].history
        past.age = 1
        past.doubted = doubted[k]
        for i in range(observation.shape[1]):
            past.sensed[i] = observation[k, i]
