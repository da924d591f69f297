"""Where things stand at the start of an episode: rejection sampling with keep-out distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pointgoal.observation import NUM_HAZARDS, NUM_VASES, FloatArray

EXTENT = {0: 1.0, 1: 1.5, 2: 2.0}
"""Half the side of the square in which things are placed, by level [m]."""
ROBOT_KEEPOUT, GOAL_KEEPOUT, HAZARD_KEEPOUT, VASE_KEEPOUT = 0.4, 0.305, 0.18, 0.15
"""Two things stand at least the sum of their keep-outs apart [m]."""
_OBJECT_TRIES = 100
_LAYOUT_TRIES = 10_000
_GOAL_TRIES = 10_000
_GOAL_BLOCK = 50


class LayoutError(RuntimeError):
    """No valid layout was found."""


@dataclass(frozen=True)
class Layout:
    """One episode's start.

    Attributes:
        pose: (3,) x, y [m], heading [rad] of the robot.
        goal: (2,) centre [m].
        hazards: (h, 2) centres [m].
        vases: (m, 2) centres [m].
        vase_yaws: (m,) [rad].
    """

    pose: FloatArray
    goal: FloatArray
    hazards: FloatArray
    vases: FloatArray
    vase_yaws: FloatArray


def keepouts(level: int) -> FloatArray:
    """Keep-outs [m] of everything but the goal, in the order robot, hazards, vases."""
    counts = [1, NUM_HAZARDS[level], NUM_VASES[level]]
    return np.repeat([ROBOT_KEEPOUT, HAZARD_KEEPOUT, VASE_KEEPOUT], counts)


def sample_layout(rng: np.random.Generator, level: int) -> Layout:
    """Draw a layout: robot, goal, hazards, vases in turn, each uniform in the extents less its keep-out.

    A thing that finds no valid place in 100 tries starts the layout over. The goal is then drawn once
    more against everything else, as the reference task does.

    Raises:
        LayoutError: if 10,000 layouts fail, or the second draw of the goal does.
    """
    rest = keepouts(level)
    order = np.insert(rest, 1, GOAL_KEEPOUT)
    for _ in range(_LAYOUT_TRIES):
        placed = _place(rng, order, EXTENT[level])
        if placed is None:
            continue
        heading = rng.uniform(0.0, 2.0 * np.pi)
        vase_yaws = rng.uniform(0.0, 2.0 * np.pi, NUM_VASES[level])
        others = np.delete(placed, 1, axis=0)
        goal = sample_goal(rng, level, others)
        if goal is None:
            raise LayoutError(f"level {level}: no place for the goal")
        first_vase = 1 + NUM_HAZARDS[level]
        return Layout(
            pose=np.array([*others[0], heading]),
            goal=goal,
            hazards=others[1:first_vase],
            vases=others[first_vase:],
            vase_yaws=vase_yaws,
        )
    raise LayoutError(f"level {level}: no layout found in {_LAYOUT_TRIES} tries")


def sample_goal(rng: np.random.Generator, level: int, others: FloatArray) -> FloatArray | None:
    """Draw a goal that keeps clear of everything else.

    Args:
        rng: the source of randomness.
        level: 0, 1 or 2.
        others: (k, 2) places [m] of the robot, the hazards and the vases, in the order of `keepouts`.

    Returns:
        (2,) the goal's centre [m], or None if 10,000 draws found no place.
    """
    reach = EXTENT[level] - GOAL_KEEPOUT
    squared = np.square(keepouts(level) + GOAL_KEEPOUT)
    for _ in range(_GOAL_TRIES // _GOAL_BLOCK):
        candidates = rng.uniform(-reach, reach, (_GOAL_BLOCK, 2))
        first = _first_valid(candidates, others, squared)
        if first is not None:
            return first
    return None


def _place(rng: np.random.Generator, order: FloatArray, extent: float) -> FloatArray | None:
    """(k, 2) places for things with keep-outs `order` (k,), or None where one found no room."""
    placed = np.empty((len(order), 2))
    for i, keepout in enumerate(order):
        reach = extent - keepout
        candidates = rng.uniform(-reach, reach, (_OBJECT_TRIES, 2))
        first = _first_valid(candidates, placed[:i], np.square(order[:i] + keepout))
        if first is None:
            return None
        placed[i] = first
    return placed


def _first_valid(candidates: FloatArray, placed: FloatArray, squared: FloatArray) -> FloatArray | None:
    """The first candidate (c, 2) whose squared distances to `placed` (k, 2) are at least `squared` (k,)."""
    dx = candidates[:, :1] - placed[:, 0]
    dy = candidates[:, 1:] - placed[:, 1]
    valid = np.all(dx * dx + dy * dy >= squared, axis=1)
    first: FloatArray
    for first in candidates[valid][:1]:
        return first
    return None
