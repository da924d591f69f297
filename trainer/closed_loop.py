"""Deterministic episodes of a policy in the task, without noise and without filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv

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
    # Rows to spare in the last batch repeat the first episodes, and are dropped.
    rows = np.arange(-(-count // env.num_envs) * env.num_envs).reshape(-1, env.num_envs) % count
    parts = [_batch(env, policy, steps, [seeds[i] for i in batch]) for batch in rows]
    reward, cost, observation = (np.concatenate(part, axis=1)[:, :count] for part in zip(*parts, strict=True))
    return Episodes(reward, cost, observation)


def _batch(
    env: Any, policy: Policy, steps: int, seeds: list[int]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    observation, _ = env.reset(seed=seeds)
    reward = np.full((steps, env.num_envs), np.nan)
    cost = np.full((steps, env.num_envs), np.nan)
    seen = np.full((steps, *observation.shape), np.nan, np.float32)
    going = np.ones(env.num_envs, np.bool_)
    for t in range(steps):
        seen[t, going] = observation[going]
        observation, r, terminated, truncated, info = env.step(policy(observation.astype(np.float32)))
        # Where an algorithm constrains something else, the task's own cost stands beside it.
        reward[t, going], cost[t, going] = r[going], info.get("task_cost", info["cost"])[going]
        going &= ~(terminated | truncated)
        if not going.any():
            break
    return reward, cost, seen
