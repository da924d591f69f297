"""What the networks see: the normalised observation, and how near the hazards are."""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pointgoal.observation import LIDAR_RANGE, layout
from trainer.config import Config
from trainer.normaliser import Normaliser

GAIN = 4.0
"""Nearness of a hazard at distance 0; the order of the largest normalised observations."""
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Nearness:
    """GAIN · exp(−distance / length) for every bin of the hazards' lidar, a reading being 1 − distance / 3 m.

    A reading hardly changes over the last decimetres, which decide whether a step costs anything: a network
    of this size then learns the cost critic to a quarter of the variance it explains with these features.

    Attributes:
        start: index of the first reading in the observation.
        stop: index after the last one.
        length: e-folding distance [m].
    """

    start: int
    stop: int
    length: float

    @property
    def rate(self) -> float:
        """Of the exponential, for a reading."""
        return LIDAR_RANGE / self.length

    def __call__(self, observation: npt.NDArray[np.floating]) -> Floats:
        """Nearness [..., bins] in raw observations [..., n]."""
        reading: Floats = observation[..., self.start : self.stop].astype(np.float32)
        near: Floats = np.exp((reading - np.float32(1)) * np.float32(self.rate))
        return near * np.float32(GAIN)


class Features:
    """Inputs of all networks from raw observations.

    Attributes:
        normaliser: of the raw observation.
        nearness: None for a task without a hazards' lidar.
    """

    def __init__(self, observations: int, nearness: Nearness | None) -> None:
        self.normaliser = Normaliser(observations)
        self.nearness = nearness
        self.size = observations + (nearness.stop - nearness.start if nearness else 0)

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
    block = layout(int(match[1])).slice("hazards_lidar")
    return Nearness(block.start, block.stop, config.nearness)
