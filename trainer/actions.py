"""From what the policy draws to what the environment is sent."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from torch import Tensor

from trainer.config import Config
from trainer.errors import ConfigError

Floats = npt.NDArray[np.float32]
USEFUL = {"PointGoal": (0.05, 1.0)}
"""Largest action that still makes a difference, by the task's name: the robot's thrust saturates at 0.05."""
DEAD = {"PointGoal": (0.0, 0.093)}
"""Largest action that makes no difference yet. The servo that turns the robot is stiffer than the physics
step resolves and chatters between ±0.476 rad/s; below 0.3 · 0.476 − 0.05 its torque saturates in both halves
of the swing, they cancel, and the robot does not turn at all."""
RAMP = 0.01
"""Draw within which the dead zone is crossed."""


@dataclass(frozen=True)
class ActionRange:
    """What the policy draws is multiplied by `unit`, moved out of the dead zone and clipped.

    A policy whose mean lies far beyond the point where the robot saturates explores nothing: every draw is
    the same thrust, and no cost can teach it to brake. So the unit is where saturation begins, and the update
    draws the mean back to `edge`. In a dead zone, noise has an effect where the mean alone has none: what is
    learnt with noise would come to a standstill without.

    Attributes:
        unit: [a].
        dead: largest action without effect [a].
        low: smallest action sent [a].
        high: largest action sent [a].
    """

    unit: Floats
    dead: Floats
    low: Floats
    high: Floats

    @property
    def edge(self) -> Floats:
        """The draw from which on nothing changes [a]."""
        edge: Floats = ((np.minimum(-self.low, self.high) - self.dead) / self.unit).astype(np.float32)
        return edge

    @property
    def gain(self) -> Floats:
        """How far the action moves for a draw that moves by 1, at most [a]."""
        gain: Floats = (self.unit + self.dead / RAMP).astype(np.float32)
        return gain

    def sent(self, drawn: Tensor) -> Tensor:
        """Actions within the bounds [..., a] for the policy's draws [..., a]."""
        unit, dead, low, high = (torch.from_numpy(of) for of in (self.unit, self.dead, self.low, self.high))
        jump = dead * (drawn * (1 / RAMP)).clamp(-1, 1)
        return torch.minimum(torch.maximum(drawn * unit + jump, low), high)


def action_range(config: Config, space: Box) -> ActionRange:
    """The range that the settings ask for within the task's bounds.

    Args:
        config: with action_range, or none to take the known useful range of the task, if there is one.
        space: the task's actions.

    Returns:
        The range.

    Raises:
        ConfigError: if the range does not fit the task's actions.
    """
    useful = config.action_range
    if useful is None:
        useful = _known(USEFUL, config.task)
    zeros = np.zeros(space.shape, np.float32)
    if not useful:
        return ActionRange(zeros + 1, zeros, space.low.astype(np.float32), space.high.astype(np.float32))
    unit = np.asarray(useful, np.float32)
    if unit.shape != space.shape or not ((unit > 0) & (unit <= np.minimum(-space.low, space.high))).all():
        raise ConfigError(f"--action-range must give {space.shape[0]} numbers above 0 within {space}")
    dead = zeros + np.asarray(_known(DEAD, config.task) or 0, np.float32)
    if (unit <= dead).any():
        raise ConfigError(f"--action-range must lie above {dead.tolist()}: smaller actions have no effect")
    return ActionRange(unit, dead, -unit, unit)


def _known(table: Mapping[str, tuple[float, ...]], task: str) -> tuple[float, ...]:
    return next((found for name, found in table.items() if task.startswith(name)), ())
