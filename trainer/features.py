"""What the networks see: the normalised observation, and how hazards and goal lie to the robot's way.

In torch, once: training computes it in single precision, and the exported graphs are traced from it. Written
for onnxruntime, where a step costs its dispatch and a small matrix product costs next to nothing: what is
linear is a product with a constant matrix, and reductions run over the last axis or are products. At run time
`inference.features` computes the same in compiled code.
"""

import numpy as np
import torch
from torch import Tensor, nn

from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, layout
from trainer.config import Config
from trainer.normaliser import Normaliser

GAIN = 4.0
"""Largest size of most of these numbers; the order of the largest normalised observations."""
COASTING = 0.519
"""Decay time of the robot's speed without thrust [s], which coasts this times its velocity."""
SHARPNESS = 12.0
"""Concentration of the map's directions: a hazard shows in those within about 1/√12 rad of its own."""
TINY = 1e-6
"""Keeps divisors from 0: a lidar's reading, a squared length [m²]."""
LARGE = 1e30
"""Makes 1 and more of every reading that is not 0; onnxruntime's sign takes ten times as long as a clip."""
_TURNED = ((1.0, 0.0, 0.0, -1.0), (0.0, 1.0, 1.0, 0.0))
"""From (x, y) to (x, y, y, −x): times (cos, sin, cos, sin), the terms of its parts along and to the left."""
_PARTS = ((1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 1.0))
"""Adds up those terms."""


class Surroundings(nn.Module):
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

    An object's distance is its reading's, its bearing within the bin the middle of what the neighbours'
    readings leave possible: exact for an object alone. A goal out of sight has no direction and no nearness.

    Attributes:
        lidars: where the goal's readings, then the hazards' stand in the observation.
        velocity: where the velocity ahead and to the left stands.
        size: numbers that it gives.
    """

    following: Tensor
    preceding: Tensor
    middle: Tensor
    quarters: Tensor
    coasting: Tensor
    ends: Tensor
    around: Tensor
    rates: Tensor
    counted: Tensor
    always: Tensor
    toward: Tensor

    def __init__(self, lidars: slice, velocity: slice, length: float) -> None:
        super().__init__()
        self.lidars = lidars
        self.velocity = velocity
        self.length = length
        self.size = 4 * LIDAR_BINS + 5
        bins = np.arange(LIDAR_BINS)
        ring = np.roll(np.eye(LIDAR_BINS), 1, 1)
        angles = bins * BIN_WIDTH
        zeros, ones = np.zeros(LIDAR_BINS), np.ones(LIDAR_BINS)
        way = GAIN * np.asarray(_PARTS)
        constants = {
            # Of both lidars, the reading of the next bin and of the one before.
            "following": np.kron(np.eye(2), ring.T),
            "preceding": np.kron(np.eye(2), ring),
            "middle": np.tile((bins + 0.5) * BIN_WIDTH, 2),
            "quarters": (np.pi / 2, 0, np.pi / 2, 0),
            "coasting": COASTING * np.asarray(_TURNED),
            # x of both segments' ends, then y, from the coasting's terms and minus the way to the goal; each
            # once a bin.
            "ends": np.kron(np.insert(np.kron(_PARTS, (1, 0)), 4, (0, -1, 0, 0), 0), ones),
            # cos(a − b) = cos a cos b + sin a sin b, for every direction of the map; then the level.
            "around": (SHARPNESS * np.cos(angles), SHARPNESS * np.sin(angles), ones),
            "rates": np.r_[np.full(3 * LIDAR_BINS, -1 / length), ones],
            # 0 for number 3 of an empty bin, GAIN and more for the rest.
            "counted": LARGE * np.kron((0, 0, 1, 0), np.eye(LIDAR_BINS)),
            "always": GAIN * np.r_[ones, ones, zeros, ones],
            # Number 5 from (cos, sin, cos, sin), the coasting's terms and exp(−distance).
            "toward": np.block(
                [
                    [np.diag((2.0, 2.0)), np.zeros((2, 3))],
                    [np.zeros((2, 5))],
                    [np.zeros((4, 3)), way],
                    [np.asarray([[0, 0, GAIN, 0, 0]])],
                ]
            ),
        }
        for name, value in constants.items():
            self.register_buffer(name, torch.from_numpy(np.asarray(value, np.float32)))

    def forward(self, observation: Tensor) -> Tensor:
        """The numbers [B, size] for raw observations [B, n]."""
        lidars = observation[:, self.lidars]
        goal, hazards = torch.split(lidars, LIDAR_BINS, 1)
        goals, bearing = torch.split(self._bearings(lidars), LIDAR_BINS, 1)
        heading = goals.gather(1, goal.argmax(1, keepdim=True))
        reading = goal.amax(1, keepdim=True)
        seen, behind = (reading * LARGE).clamp(max=1), (reading - 1) * LIDAR_RANGE
        turn = torch.sin(heading + self.quarters)
        coasting = turn * (observation[:, self.velocity] @ self.coasting)

        # From here on in the goal's frame: ahead is where the goal is.
        relative, distance = bearing - heading, (1 - hazards) * LIDAR_RANGE
        direction = torch.cat([torch.cos(relative), torch.sin(relative)], 1)
        ends = torch.cat([coasting, behind * seen], 1) @ self.ends
        apart = self._from_segments(direction, distance, ends)
        shown = self._map(direction * seen, distance)
        exponent = torch.cat([distance, apart, shown], 1) * self.rates
        near = torch.exp(exponent) * torch.addmm(self.always, hazards, self.counted).clamp(max=GAIN)
        to_goal = torch.cat([turn, coasting, torch.exp(behind)], 1) @ self.toward
        return torch.cat([near, to_goal * seen], 1)

    def _bearings(self, lidars: Tensor) -> Tensor:
        """Bearing [rad] of the object in every bin of both lidars [B, 2 bins]."""
        divisor = lidars.clamp(min=TINY)
        upper = torch.minimum(lidars @ self.following, divisor)
        lower = torch.minimum(lidars @ self.preceding, divisor)
        return (upper - lower) / divisor * (BIN_WIDTH / 2) + self.middle

    def _from_segments(self, direction: Tensor, distance: Tensor, ends: Tensor) -> Tensor:
        """Distances [B, 2 bins] of hazards from the segments between the robot and two ends.

        The hazards lie in `direction` [B, 2 bins], cosines and sines, at a `distance` [B, bins]. The `ends`
        [B, 4 bins] are x of the first, x of the second, y of the first, y of the second, each once a bin: all
        flat, for onnxruntime takes its time over broadcasting.
        """
        x, y = torch.split(direction * torch.cat([distance, distance], 1), LIDAR_BINS, 1)
        place = torch.cat([x, x, y, y], 1)
        share = (_sum(place * ends) / (_sum(ends * ends) + TINY)).clamp(0, 1)
        apart = place - torch.cat([share, share], 1) * ends
        return torch.sqrt(_sum(apart * apart))

    def _map(self, direction: Tensor, distance: Tensor) -> Tensor:
        """log(number 4 / GAIN) [B, bins] of hazards' directions [B, 2 bins] and distances [B, bins]."""
        level = distance * (-0.5 / self.length) - SHARPNESS
        rays = torch.cat([direction, level], 1).view(-1, 3, LIDAR_BINS)
        return (rays.transpose(1, 2) @ self.around).amax(1)


def _sum(parts: Tensor) -> Tensor:
    """Of x and y [B, 4 bins] of two segments [B, 2 bins]."""
    x, y = torch.split(parts, 2 * LIDAR_BINS, 1)
    return x + y


class Features(nn.Module):
    """Inputs of all networks from raw observations.

    Attributes:
        normaliser: of the raw observation.
        surroundings: None for a task without a hazards' lidar.
        size: numbers that it gives.
    """

    def __init__(self, observations: int, surroundings: Surroundings | None) -> None:
        super().__init__()
        self.normaliser = Normaliser(observations)
        self.surroundings = surroundings
        self.size = observations + (surroundings.size if surroundings else 0)

    @property
    def dtype(self) -> torch.dtype:
        """The precision that they are computed in."""
        return self.normaliser.center.dtype

    def forward(self, observation: Tensor) -> Tensor:
        """Inputs [B, size] of raw observations [B, n]."""
        normalised: Tensor = self.normaliser(observation)
        if self.surroundings is None:
            return normalised
        return torch.cat([normalised, self.surroundings(observation)], 1)


def surroundings(config: Config) -> Surroundings | None:
    """The surroundings of the task; None if it has no hazards, or config.nearness is 0."""
    if not config.level or config.nearness == 0:
        return None
    where = layout(config.level)
    goal, hazards = where.slice("goal_lidar"), where.slice("hazards_lidar")
    start = where.slice("velocimeter").start
    return Surroundings(slice(goal.start, hazards.stop), slice(start, start + 2), config.nearness)
