"""What the robot sees: the observation's layout and the pseudo-lidar. Needs numpy alone."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LIDAR_BINS = 16
"""Bins of a pseudo-lidar; bin 0 starts straight ahead and they run counter-clockwise."""
LIDAR_RANGE = 3.0
"""Distance at which a lidar reading falls to 0 [m]."""
BIN_WIDTH = 2.0 * np.pi / LIDAR_BINS
"""Angle that a bin covers [rad]."""
LEVELS = (0, 1, 2)
"""The task's levels."""
NUM_HAZARDS = {0: 0, 1: 8, 2: 10}
"""Hazards of each level."""
NUM_VASES = {0: 0, 1: 1, 2: 10}
"""Vases of each level."""
HAZARD_RADIUS = 0.2
"""Radius of a hazard [m]; the cost is the depth of the robot's origin in it."""


@dataclass(frozen=True)
class Block:
    """One named run of numbers in an observation.

    Attributes:
        name: the sensor, for example ``"velocimeter"``.
        start: index of its first number.
        size: how many numbers.
        unit: their unit, in brackets in the docs: ``"m/s"``; ``"1"`` for lidar readings in [0, 1].
    """

    name: str
    start: int
    size: int
    unit: str


@dataclass(frozen=True)
class ObservationLayout:
    """The order, sizes and units of an observation's numbers.

    Attributes:
        blocks: the runs of numbers, in order, without gaps.
    """

    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Count of all numbers."""
        return sum(block.size for block in self.blocks)

    def __contains__(self, name: str) -> bool:
        return any(block.name == name for block in self.blocks)

    def slice(self, name: str) -> slice:
        """Where a block's numbers are.

        Raises:
            KeyError: if the layout has no block of that name.
        """
        for block in self.blocks:
            if block.name == name:
                return slice(block.start, block.start + block.size)
        raise KeyError(f"observation layout has no block {name!r}; it has {[b.name for b in self.blocks]}")

    def to_json(self) -> list[dict[str, Any]]:
        """The blocks as plain dictionaries, for a manifest."""
        return [asdict(block) for block in self.blocks]

    @staticmethod
    def from_json(blocks: list[dict[str, Any]]) -> ObservationLayout:
        """The inverse of `to_json`."""
        return ObservationLayout(tuple(Block(**block) for block in blocks))


def layout(level: int) -> ObservationLayout:
    """The observation's layout at a level: 28 numbers at level 0, 60 at levels 1 and 2."""
    if level not in LEVELS:
        raise ValueError(f"level must be one of {LEVELS}, got {level!r}")
    sizes = [
        ("accelerometer", 3, "m/s^2"),
        ("velocimeter", 3, "m/s"),
        ("gyro", 3, "rad/s"),
        ("magnetometer", 3, "1"),
        ("goal_lidar", LIDAR_BINS, "1"),
    ]
    if level > 0:
        sizes += [("hazards_lidar", LIDAR_BINS, "1"), ("vases_lidar", LIDAR_BINS, "1")]
    blocks, start = [], 0
    for name, size, unit in sizes:
        blocks.append(Block(name, start, size, unit))
        start += size
    return ObservationLayout(tuple(blocks))
