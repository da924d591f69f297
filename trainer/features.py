"""What the networks see: the normalised observation, and how near the hazards are and will be."""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, layout
from trainer.config import Config
from trainer.normaliser import Normaliser

GAIN = 4.0
"""Nearness of a hazard at distance 0; the order of the largest normalised observations."""
COASTING = 0.519
"""Decay time of the robot's speed without thrust [s], which coasts this times its velocity."""
TINY = 1e-6
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Nearness:
    """For every bin of the hazards' lidar: how near its hazard is, and how near it comes if the robot coasts.

    Each is GAIN · exp(−distance / length). A reading hardly changes over the last decimetres, which decide
    whether a step costs anything; and what decides whether one of the next steps will is the distance of the
    hazard from the way on which the robot coasts to rest, a segment of COASTING times the velocity. From
    these numbers a network of this size learns far more of the cost than from readings and velocity.

    A hazard's distance is its reading's, its bearing within the bin the middle of what the neighbours'
    readings leave possible (exact for a hazard alone).

    Attributes:
        readings: where the readings stand in the observation.
        velocity: where the velocity ahead and to the left stands.
        length: e-folding distance [m].
    """

    readings: slice
    velocity: slice
    length: float

    @property
    def size(self) -> int:
        """Numbers that it gives."""
        return 2 * LIDAR_BINS

    def __call__(self, observation: npt.NDArray[np.floating]) -> Floats:
        """Both nearnesses [..., 2 · bins] in raw observations [..., n]."""
        reading: Floats = observation[..., self.readings].astype(np.float32)
        distance = (1 - reading) * np.float32(LIDAR_RANGE)
        divisor = np.maximum(reading, np.float32(TINY))
        upper = np.minimum(np.roll(reading, -1, -1) / divisor, 1)
        lower = np.maximum(1 - np.roll(reading, 1, -1) / divisor, 0)
        bearing = (np.arange(LIDAR_BINS, dtype=np.float32) + (lower + upper) / 2) * np.float32(BIN_WIDTH)
        x, y = distance * np.cos(bearing), distance * np.sin(bearing)
        way = observation[..., self.velocity].astype(np.float32) * np.float32(COASTING)
        dx, dy = way[..., :1], way[..., 1:]
        share = np.clip((x * dx + y * dy) / (dx * dx + dy * dy + np.float32(TINY)), 0, 1)
        passing = np.sqrt((x - share * dx) ** 2 + (y - share * dy) ** 2)
        rate = np.float32(-1 / self.length)
        near: Floats = np.float32(GAIN) * np.exp(rate * np.concatenate([distance, passing], axis=-1))
        return near


class Features:
    """Inputs of all networks from raw observations.

    Attributes:
        normaliser: of the raw observation.
        nearness: None for a task without a hazards' lidar.
    """

    def __init__(self, observations: int, nearness: Nearness | None) -> None:
        self.normaliser = Normaliser(observations)
        self.nearness = nearness
        self.size = observations + (nearness.size if nearness else 0)

    def __call__(self, observation: npt.NDArray[np.floating]) -> Floats:
        """Inputs [..., size] of raw observations [..., n]."""
        normalised = self.normaliser(observation)
        if self.nearness is None:
            return normalised
        return np.concatenate([normalised, self.nearness(observation)], axis=-1)


def nearness(config: Config) -> Nearness | None:
    """The nearness of the task's hazards; None if it has none, or config.nearness is 0."""
    match = re.fullmatch(r"PointGoal([12])-v\d+", config.task)
    if match is None or config.nearness == 0:
        return None
    where = layout(int(match[1]))
    start = where.slice("velocimeter").start
    return Nearness(where.slice("hazards_lidar"), slice(start, start + 2), config.nearness)
