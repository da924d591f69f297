"""The way round: the shortest path past the hazards to the goal, and the action that follows it.

A policy that keeps pushing at a hazard would stand in front of it for ever: no certificate can change that.
So while a hazard stands in the straight way to the goal, the filter's reference is not the nominal action
but the one that drives along the shortest path round it. Hazards are discs, so the path runs along their
tangents; it is found by a best-first search over tangent lines (a tangent visibility graph, expanded only
where it is needed).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from system.backups import steered
from system.compiled import compiled
from system.point_robot import State, advance, stopping

FloatArray = NDArray[np.float64]
Settings = Any
"""One row of `guide.GUIDE`, in compiled code."""
IntArray = NDArray[np.int64]

_NODES = 64
"""Most points that a search looks at."""
_HOP = math.tan(math.radians(20.0))
"""The path goes past each tangent point by this share of the radius: round a disc in hops of 40 degrees."""
_TURN_MOTION = 0.5
"""Length that it costs to give up a metre of the way to the stop point."""
_TURN_HEADING = 0.4
"""Length that it costs to turn by a radian [m]."""
_ALONG = 0.5
"""Least cosine of the angle to the way round of a thrust that counts as driving round."""
_SAME_END = 0.5
"""Cosine of the heading's error that a robot on the move puts up with before its other end leads."""
_ON_THE_MOVE = 0.1
"""Way ahead to the stop point from which on it puts up with all of that [m]."""
_GAIN = 0.7
"""Share of the heading's error that is turned away in a control step."""
_TRIES = 5
"""Most discs that one hop is moved aside for."""


class Path(NamedTuple):
    """The first leg of a path round the hazards.

    Attributes:
        x, y: its end [m].
        blocker: the disc in the straight way, -1 if there is none.
        distance: how far off that is [m].
        side: 1 if the robot passes to the left of the first disc, else -1; 0 without one.
    """

    x: float
    y: float
    blocker: int
    distance: float
    side: int


@compiled
def first_hit(
    discs: FloatArray, count: int, x0: float, y0: float, x1: float, y1: float, skip: int
) -> tuple[int, float]:
    """The first disc that a segment enters, and how far along [m]; -1 if there is none.

    A disc that holds the start counts only if the segment leads deeper into it.
    """
    dx = x1 - x0
    dy = y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    if length < 1e-9:
        return -1, 0.0
    dx /= length
    dy /= length
    nearest = -1
    least = length
    for i in range(count):
        if i == skip:
            continue
        cx = discs[i, 0] - x0
        cy = discs[i, 1] - y0
        along = cx * dx + cy * dy
        if along <= 0.0:
            continue
        square = cx * cx + cy * cy
        radius = min(discs[i, 2], 0.99 * math.sqrt(square))
        aside = square - along * along
        if aside >= radius * radius * 0.998:
            continue
        at = along - math.sqrt(radius * radius - aside)
        if at < least:
            least = at
            nearest = i
    return nearest, least


@compiled
def tangent(discs: FloatArray, i: int, x: float, y: float, side: int) -> tuple[float, float]:
    """The point to drive to from (x, y) to pass a disc on a side: a little past the tangent point."""
    cx = discs[i, 0] - x
    cy = discs[i, 1] - y
    distance = math.sqrt(cx * cx + cy * cy)
    radius = min(discs[i, 2], 0.99 * distance)
    way = math.sqrt(distance * distance - radius * radius)
    sine = side * radius / distance
    cosine = way / distance
    ux = cx / distance
    uy = cy / distance
    way += radius * _HOP
    return x + way * (cosine * ux - sine * uy), y + way * (sine * ux + cosine * uy)


@compiled
def _hop(
    discs: FloatArray, count: int, x: float, y: float, blocker: int, side: int
) -> tuple[bool, float, float]:
    """A free way from (x, y) past a disc, or those beside it, on a side: whether there is one; its end."""
    disc = blocker
    for _ in range(_TRIES):
        tx, ty = tangent(discs, disc, x, y, side)
        other, _ = first_hit(discs, count, x, y, tx, ty, disc)
        if other < 0:
            return True, tx, ty
        disc = other
    return False, x, y


@compiled
def _cheapest(nodes: FloatArray, size: int) -> int:
    """The open node with the least estimate, -1 if none is open."""
    best = -1
    for i in range(size):
        if nodes[i, 5] < math.inf and (best < 0 or nodes[i, 5] < nodes[best, 5]):
            best = i
    return best


@compiled
def _change(x: float, y: float, zx: float, zy: float, way: int, side: int, steadiness: float) -> float:
    """What a first leg to (x, y) costs beyond its length [m]: turning motion, heading, and mind."""
    leg = math.hypot(x, y)
    cost = _TURN_MOTION * (math.hypot(zx, zy) - (zx * x + zy * y) / leg)
    # Either end may lead.
    cost += _TURN_HEADING * math.atan2(abs(y), abs(x))
    if side == -way:
        cost += steadiness
    return cost


@compiled
def shortest_path(
    discs: FloatArray,
    count: int,
    goal: tuple[float, float],
    stop: tuple[float, float],
    side: int,
    steadiness: float,
) -> Path:
    """Search for the shortest path from the origin to the goal.

    Args:
        discs: (M, 3) centres and radii [m].
        count: how many of them there are.
        goal: its centre [m].
        stop: the robot's stop point [m]; the side that its motion favours costs less.
        side: the side chosen before, or 0.
        steadiness: what the other side costs more [m].

    Returns:
        The path's first leg; the straight way if nothing blocks it or if no way round was found.
    """
    gx, gy = goal
    blocker, distance = first_hit(discs, count, 0.0, 0.0, gx, gy, -1)
    straight = math.hypot(gx, gy)
    if blocker < 0:
        return Path(gx, gy, -1, straight, 0)
    # One row a node: x, y, length of the path so far, first leg's end x, y, estimate of the whole.
    nodes = np.zeros((_NODES, 6))
    sides = np.zeros(_NODES, dtype=np.int64)
    nodes[0, 5] = straight
    size = 1
    while True:
        best = _cheapest(nodes, size)
        if best < 0:
            return Path(gx, gy, blocker, distance, 0)
        x, y = nodes[best, 0], nodes[best, 1]
        nodes[best, 5] = math.inf
        hit, _ = first_hit(discs, count, x, y, gx, gy, -1)
        if hit < 0 or size + 2 > _NODES:
            return Path(nodes[best, 3], nodes[best, 4], blocker, distance, sides[best])
        for way in (1, -1):
            free, tx, ty = _hop(discs, count, x, y, hit, way)
            if not free:
                continue
            nodes[size] = nodes[best]
            nodes[size, 0] = tx
            nodes[size, 1] = ty
            nodes[size, 2] += math.hypot(tx - x, ty - y)
            sides[size] = sides[best]
            if best == 0:
                nodes[size, 2] += _change(tx, ty, stop[0], stop[1], way, side, steadiness)
                nodes[size, 3] = tx
                nodes[size, 4] = ty
                sides[size] = way
            nodes[size, 5] = nodes[size, 2] + math.hypot(gx - tx, gy - ty)
            size += 1


@compiled
def steer(
    settings: Settings, discs: FloatArray, count: int, state: State, x: float, y: float
) -> tuple[float, float]:
    """The action that takes the stop point towards a line from the robot through a point.

    A robot that is nearer to a disc than the way round would be drives away from it as well.

    Args:
        settings: the filter's numbers.
        discs: (M, 3) centres and radii [m].
        count: how many of them there are.
        state: the measured state.
        x: of the point [m].
        y: of the point [m].

    Returns:
        The share of full thrust and the turn, both in [-1, 1].
    """
    at = stopping(settings.robot, state)
    distance = math.hypot(x, y) + 1e-9
    ux = x / distance
    uy = y / distance
    for i in range(count):
        away = math.hypot(discs[i, 0], discs[i, 1])
        if away < discs[i, 2]:
            push = settings.repulsion * min((discs[i, 2] - away) / settings.clearance, 2.0)
            ux -= push * discs[i, 0] / away
            uy -= push * discs[i, 1] / away
    error = math.atan2(uy * settings.pursuit - at.zy, ux * settings.pursuit - at.zx) - at.heading
    # It drives as well backwards: the end that is nearer to the way leads, if the other does not already.
    ahead = (at.zx - at.x) * math.cos(at.heading) + (at.zy - at.y) * math.sin(at.heading)
    end = 1.0
    if math.cos(error) + _SAME_END * min(max(ahead / _ON_THE_MOVE, -1.0), 1.0) < 0.0:
        end = -1.0
    error = math.atan2(end * math.sin(error), end * math.cos(error))
    thrust = min(max(settings.eagerness * math.cos(error), -1.0), 1.0)
    return end * thrust, steered(settings.robot, _GAIN * error)


@compiled
def drives_round(
    settings: Settings, discs: FloatArray, count: int, state: State, action: FloatArray, way: Path
) -> bool:
    """Whether an action (u1, u2) leads past the disc in the way by itself.

    It does if it thrusts roughly along the way round, and motion and thrust lead past every disc.
    """
    robot = settings.robot
    after = stopping(robot, advance(robot, state, action[0], action[1], robot.substeps))
    heading = after.heading if action[0] >= 0.0 else after.heading + math.pi
    x = after.zx + settings.lookahead * math.cos(heading)
    y = after.zy + settings.lookahead * math.sin(heading)
    if abs(action[0]) < 0.5 * robot.force_limit:
        return False
    # Thrust away from the disc is no way round it.
    toward = way.x * math.cos(heading) + way.y * math.sin(heading)
    if toward < _ALONG * math.hypot(way.x, way.y):
        return False
    if first_hit(discs, count, after.x, after.y, after.zx, after.zy, -1)[0] >= 0:
        return False
    return first_hit(discs, count, after.zx, after.zy, x, y, -1)[0] < 0
