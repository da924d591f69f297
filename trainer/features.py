"""What the networks see: the normalised observation, and how hazards and goal lie to the robot's way."""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pointgoal.lidar import TINY, nearest, places
from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, layout
from trainer.config import Config
from trainer.normaliser import Normaliser

GAIN = 4.0
"""Largest size of most of these numbers; the order of the largest normalised observations."""
COASTING = 0.519
"""Decay time of the robot's speed without thrust [s], which coasts this times its velocity."""
SHARPNESS = 12.0
"""Concentration of the map's directions: a hazard shows in those within about 1/√12 rad of its own."""
Floats = npt.NDArray[np.float32]
DIRECTIONS: Floats = np.arange(LIDAR_BINS, dtype=np.float32) * np.float32(BIN_WIDTH)
"""The map's directions from the goal's, counter-clockwise [rad]."""


@dataclass(frozen=True)
class Surroundings:
    """How near the hazards are and will be, where the goal is, and what lies on the way there.

    A lidar reading hardly changes over the last decimetres, which decide whether a step costs anything; what
    decides whether one of the next steps will is the way on which the robot coasts to rest, a segment of
    COASTING times the velocity; and what decides the return is what lies between the robot and the goal. A
    network of this size learns far more of that from the numbers below than from bins that turn with the
    robot. With near(x) = GAIN · exp(−x / length), they are

    1. for every bin of the hazards' lidar, near(its hazard's distance),
    2. near(that hazard's distance from the segment on which the robot would coast to rest),
    3. near(its distance from the segment to the goal), or 0 for an empty bin;
    4. a map that turns with the goal: for as many directions as bins, counter-clockwise from the goal's, the
       largest GAIN · exp(−distance / 2 length) of a hazard there, falling with the angle between the two;
    5. twice the unit vector to the goal (ahead, left), GAIN · exp(−its distance / 1 m), and GAIN times the
       way on which the robot would coast (along that vector, to the left of it).

    Where an object is, `pointgoal.lidar.places` says. A goal out of sight has no direction and no nearness.

    Attributes:
        hazards: where the hazards' readings stand in the observation.
        goal: where the goal's readings stand.
        velocity: where the velocity ahead and to the left stands.
        length: e-folding distance [m].
    """

    hazards: slice
    goal: slice
    velocity: slice
    length: float

    @property
    def size(self) -> int:
        """Numbers that it gives."""
        return 4 * LIDAR_BINS + 5

    def __call__(self, observation: Floats) -> Floats:
        """The numbers [..., size] for raw observations [..., n], of the same precision."""
        hazards = observation[..., self.hazards]
        x, y, distance = places(hazards)
        ux, uy, away, seen = _goal(observation[..., self.goal])
        coast = observation[..., self.velocity] * np.float32(COASTING)
        cx, cy = coast[..., :1], coast[..., 1:]
        rate, gain = np.float32(-1 / self.length), np.float32(GAIN)
        to_goal = _from_segment(x, y, ux * away, uy * away)
        near = np.concatenate([distance, _from_segment(x, y, cx, cy), to_goal], axis=-1)
        near = gain * np.exp(rate * near)
        near[..., -LIDAR_BINS:] *= hazards > 0
        shown = self._map(*_turned(x, y, ux, uy), distance)
        coasting = [gain * part for part in _turned(cx, cy, ux, uy)]
        goal = 2 * ux, 2 * uy, gain * seen * np.exp(-away), *coasting
        result: Floats = np.concatenate([near, shown, *goal], axis=-1)
        return result

    def _map(self, along: Floats, left: Floats, distance: Floats) -> Floats:
        """Number 4, from the hazards' places in the frame of the goal [..., bins]."""
        ratio = np.float32(SHARPNESS) / np.maximum(distance, np.float32(TINY))
        cosine = (ratio * along)[..., None] * np.cos(DIRECTIONS)
        cosine = cosine + (ratio * left)[..., None] * np.sin(DIRECTIONS)
        level = distance * np.float32(-0.5 / self.length) - np.float32(SHARPNESS)
        shown: Floats = np.float32(GAIN) * np.exp((cosine + level[..., None]).max(-2))
        return shown


def _goal(reading: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Of the only object: unit vector x, y (0 out of sight), distance [m], 1 in sight, else 0 [..., 1]."""
    x, y, distance, seen = nearest(reading)
    divisor: Floats = np.maximum(distance, np.float32(TINY))
    return seen * x / divisor, seen * y / divisor, distance, seen


def _turned(x: Floats, y: Floats, ux: Floats, uy: Floats) -> tuple[Floats, Floats]:
    """Parts of (x, y) along the unit vector (ux, uy) and to the left of it."""
    return x * ux + y * uy, y * ux - x * uy


def _from_segment(x: Floats, y: Floats, dx: Floats, dy: Floats) -> Floats:
    """Distance of places [..., bins] from the segment between the robot and (dx, dy) [..., 1]."""
    share = np.clip((x * dx + y * dy) / (dx * dx + dy * dy + np.float32(TINY)), 0, 1)
    apart: Floats = np.sqrt((x - share * dx) ** 2 + (y - share * dy) ** 2)
    return apart


class Features:
    """Inputs of all networks from raw observations.

    Attributes:
        normaliser: of the raw observation.
        surroundings: None for a task without a hazards' lidar.
    """

    def __init__(self, observations: int, surroundings: Surroundings | None) -> None:
        self.normaliser = Normaliser(observations)
        self.surroundings = surroundings
        self.size = observations + (surroundings.size if surroundings else 0)

    def __call__(self, observation: npt.NDArray[np.floating], dtype: type = np.float32) -> Floats:
        """Inputs [..., size] of raw observations [..., n], computed in the precision of `dtype`."""
        normalised = self.normaliser(observation, dtype)
        if self.surroundings is None:
            return normalised
        return np.concatenate([normalised, self.surroundings(observation.astype(dtype))], axis=-1)


def surroundings(config: Config) -> Surroundings | None:
    """The surroundings of the task; None if it has no hazards, or config.nearness is 0."""
    match = re.fullmatch(r"PointGoal([12])-v\d+", config.task)
    if match is None or config.nearness == 0:
        return None
    where = layout(int(match[1]))
    start = where.slice("velocimeter").start
    return Surroundings(
        where.slice("hazards_lidar"),
        where.slice("goal_lidar"),
        slice(start, start + 2),
        config.nearness,
    )
