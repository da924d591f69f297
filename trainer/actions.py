"""From what the policy draws to what the environment is sent."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from trainer.config import Config
from trainer.errors import ConfigError

Floats = npt.NDArray[np.float32]
USEFUL = {"PointGoal": (0.05, 1.0)}
"""Largest action that still makes a difference, by the task's name: the robot's thrust saturates at 0.05."""


@dataclass(frozen=True)
class ActionRange:
    """The policy draws in units of `unit`; what it draws is multiplied and clipped.

    A policy whose mean lies far beyond the point where the robot saturates explores nothing: every draw is
    the same thrust, and no cost can teach it to brake. So the unit is where saturation begins, and the update
    draws the mean back to `edge`.

    Attributes:
        unit: [a].
        low: smallest action sent [a].
        high: largest action sent [a].
    """

    unit: Floats
    low: Floats
    high: Floats

    @property
    def edge(self) -> Floats:
        """The draw from which on nothing changes [a]."""
        edge: Floats = (np.minimum(-self.low, self.high) / self.unit).astype(np.float32)
        return edge

    def sent(self, drawn: Floats) -> Floats:
        """Actions within the bounds [..., a] for the policy's draws [..., a]."""
        action: Floats = np.clip(drawn * self.unit, self.low, self.high)
        return action


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
        useful = next((found for name, found in USEFUL.items() if config.task.startswith(name)), ())
    if not useful:
        ones = np.ones(space.shape, np.float32)
        return ActionRange(ones, space.low.astype(np.float32), space.high.astype(np.float32))
    unit = np.asarray(useful, np.float32)
    if unit.shape != space.shape or (unit <= 0).any() or (unit > np.minimum(-space.low, space.high)).any():
        raise ConfigError(f"--action-range must give {space.shape[0]} numbers above 0 within {space}")
    return ActionRange(unit, -unit, unit)
