"""Deterministic episodes of a policy in the task, without noise and without filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv

from pointgoal.loop import drive, groups

Policy = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]


@dataclass(frozen=True)
class Episodes:
    """E whole episodes of T steps each, shorter ones filled up with NaN.

    Attributes:
        reward: [T, E].
        cost: [T, E].
        observation: before each step [T, E, n].
    """

    reward: npt.NDArray[np.float64]
    cost: npt.NDArray[np.float64]
    observation: npt.NDArray[np.float32]

    @property
    def returns(self) -> npt.NDArray[np.float64]:
        """Undiscounted return of each episode [E]."""
        return np.asarray(np.nansum(self.reward, 0))

    @property
    def costs(self) -> npt.NDArray[np.float64]:
        """Undiscounted cost of each episode [E]."""
        return np.asarray(np.nansum(self.cost, 0))


def episodes(env: VectorEnv[Any, Any, Any], policy: Policy, seeds: Sequence[int], steps: int) -> Episodes:
    """Runs one whole episode for each seed, env.num_envs at a time.

    Args:
        env: with autoreset in the same step.
        policy: observations [N, n] → actions [N, a] within bounds.
        seeds: of the layouts [E].
        steps: longest an episode may last [steps].

    Returns:
        The E episodes, in the seeds' order.
    """
    count = len(seeds)
    reward = np.full((steps, count), np.nan)
    cost = np.full((steps, count), np.nan)
    seen = np.full((steps, count, *env.single_observation_space.shape), np.nan, np.float32)  # type: ignore[misc]

    def act(observation: npt.NDArray[Any], _: Any) -> npt.NDArray[np.float32]:
        return policy(observation.astype(np.float32))

    for part in groups(count, env.num_envs):
        for t, step in enumerate(drive(env, act, seeds[part], steps)):
            rows = np.flatnonzero(step.running)
            there = part.start + rows
            reward[t, there], cost[t, there] = step.reward[rows], step.cost[rows]
            seen[t, there] = step.observation[rows]
    return Episodes(reward, cost, seen)
