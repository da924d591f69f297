"""The way round: the shortest path past the hazards to the goal, and the action that takes the robot along it.

A policy that keeps pushing at a hazard would stand in front of it for ever: no certificate can change that. So while
a hazard stands in the straight way to the goal, the filter's reference is not the nominal action but the one that
drives along the shortest path round it. Hazards are discs, so the path runs along their tangents; it is found by a
best-first search over tangent lines (a tangent visibility graph, expanded only where it is needed).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter.compiled import compiled
from filter.config import Settings
from filter.robot import State, stopping

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NODES = 64
"""Most points that a search looks at."""
_HOP = math.tan(math.radians(20.0))
"""The path goes past each tangent point by this share of the radius: round a disc in hops of 40 degrees."""
_TRIES = 5
"""Most discs that one hop is moved aside for."""


class Path(NamedTuple):
    """The first leg of a path round the hazards.

    Attributes:
        x, y: its end [m].
        blocker: the disc in the straight way, -1 if there is none.
        distance: how far off that is [m].
        side: 1 if the first disc is passed with the robot to the left of it, else -1; 0 without one.
        length: of the whole path, an estimate [m].
    """

    x: float
    y: float
    blocker: int
    distance: float
    side: int
    length: float


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
def tangent(disc: FloatArray, x: float, y: float, side: int) -> tuple[float, float]:
    """The point to drive to from (x, y) to pass a disc on a side: a little past the tangent point."""
    cx = disc[0] - x
    cy = disc[1] - y
    distance = math.sqrt(cx * cx + cy * cy)
    radius = min(disc[2], 0.99 * distance)
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
) -> tuple[bool, float, float, int]:
    """A free way from (x, y) past a disc on a side: whether there is one, its end, and the disc it passes."""
    disc = blocker
    for _ in range(_TRIES):
        tx, ty = tangent(discs[disc], x, y, side)
        other, _ = first_hit(discs, count, x, y, tx, ty, disc)
        if other < 0:
            return True, tx, ty, disc
        disc = other
    return False, x, y, disc


@compiled
def shortest_path(
    discs: FloatArray, count: int, goal_x: float, goal_y: float, vx: float, vy: float, side: int, mind: float
) -> Path:
    """Search for the shortest path from the origin to the goal.

    Args:
        discs: (M, 3) centres and radii [m].
        count: how many of them there are.
        goal_x: of the goal [m].
        goal_y: of the goal [m].
        vx: where the motion carries the robot, from the origin [m]: the side that it favours costs less.
        vy: likewise.
        side: the side chosen before, or 0.

    Returns:
        The path's first leg; the straight way if nothing blocks it or if no way round was found.
    """
    blocker, distance = first_hit(discs, count, 0.0, 0.0, goal_x, goal_y, -1)
    straight = math.hypot(goal_x, goal_y)
    if blocker < 0:
        return Path(goal_x, goal_y, -1, straight, 0, straight)
    # One row a node: x, y, length of the path so far, first leg's end x, y, estimate of the whole.
    nodes = np.empty((_NODES, 6))
    first_side = np.zeros(_NODES, dtype=np.int64)
    nodes[0] = (0.0, 0.0, 0.0, 0.0, 0.0, straight)
    size = 1
    while True:
        best = -1
        for i in range(size):
            if nodes[i, 5] < 1e9 and (best < 0 or nodes[i, 5] < nodes[best, 5]):
                best = i
        if best < 0:
            return Path(goal_x, goal_y, blocker, distance, 0, straight)
        x, y, length = nodes[best, 0], nodes[best, 1], nodes[best, 2]
        estimate = nodes[best, 5]
        nodes[best, 5] = math.inf
        hit, _ = first_hit(discs, count, x, y, goal_x, goal_y, -1)
        if hit < 0 or size + 2 > _NODES:
            return Path(nodes[best, 3], nodes[best, 4], blocker, distance, first_side[best], estimate)
        for turn in range(2):
            way = 1 - 2 * turn
            free, tx, ty, _ = _hop(discs, count, x, y, hit, way)
            if not free:
                continue
            leg = math.hypot(tx - x, ty - y)
            nodes[size, 0] = tx
            nodes[size, 1] = ty
            nodes[size, 2] = length + leg
            if best == 0:
                nodes[size, 3] = tx
                nodes[size, 4] = ty
                first_side[size] = way
                # Turning the motion costs way, and so does a change of mind.
                nodes[size, 2] += 0.5 * (math.hypot(vx, vy) - (vx * tx + vy * ty) / leg)
                if side == -way:
                    nodes[size, 2] += mind
                nodes[size, 2] += 0.1 * abs(math.atan2(ty, tx))
            else:
                nodes[size, 3] = nodes[best, 3]
                nodes[size, 4] = nodes[best, 4]
                first_side[size] = first_side[best]
            nodes[size, 5] = nodes[size, 2] + math.hypot(goal_x - tx, goal_y - ty)
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
    error = math.atan2(math.sin(error), math.cos(error))
    robot = settings.robot
    most = robot.gear / (robot.gear * robot.gear + robot.yaw_drag) * robot.physics_step * robot.substeps
    turn = min(max(0.7 * error / most, -1.0), 1.0)
    thrust = min(max(settings.eager * math.cos(error), -1.0), 1.0)
    return thrust, turn
