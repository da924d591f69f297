"""SCPO [Zhao 2023]: CPO's step on the maximum-cost MDP."""

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper

from trainer.algorithms.base import Algorithm
from trainer.algorithms.cpo import cpo_update
from trainer.critics import fit_critics
from trainer.learner import Batch
from trainer.rollout import Figures, Trajectory


class MaximumCost(VectorWrapper):
    """The maximum-cost MDP: the observation gains M, the largest cost so far in the episode.

    info["cost"] becomes max(cost − M, 0), whose sum over an episode is the episode's largest cost;
    info["task_cost"] keeps the task's.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        space: Any = env.single_observation_space
        self._maximum = np.zeros(env.num_envs)
        self.single_observation_space = gymnasium.spaces.Box(
            np.append(space.low, 0.0), np.append(space.high, np.inf), dtype=np.float64
        )

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Resets all episodes."""
        env: Any = self.env
        observation, info = env.reset(seed=seed, options=options)
        self._maximum = np.zeros(self.num_envs)
        return self._augmented(observation), info

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[Any, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]]:
        """Steps all episodes."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        cost = info["cost"]
        surrogate = np.maximum(cost - self._maximum, 0.0)
        self._maximum = np.maximum(cost, self._maximum)
        info = info | {"cost": surrogate, "task_cost": cost}
        if "final_obs" in info:
            info["final_obs"] = self._augmented(np.stack(info["final_obs"]))
        self._maximum = np.where(terminated | truncated, 0.0, self._maximum)
        return self._augmented(observation), reward, terminated, truncated, info

    def _augmented(self, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.concatenate([observation, self._maximum[:, None]], axis=1)

    def state_dict(self) -> dict[str, npt.NDArray[Any]]:
        """The environment's and M."""
        env: Any = self.env
        return {**env.state_dict(), "maximum_cost": self._maximum}

    def load_state_dict(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Takes on a state that state_dict returned."""
        env: Any = self.env
        self._maximum = state["maximum_cost"].copy()
        env.load_state_dict({name: value for name, value in state.items() if name != "maximum_cost"})


class SCPO(Algorithm):
    """CPO's step with E[largest cost of an episode] ≤ w as its constraint, undiscounted."""

    def batch(self, trajectory: Trajectory) -> Batch:
        """The cost undiscounted and over at the episode's end: the increments add up to its largest cost."""
        return self.learner.batch(trajectory, 1.0, cost_outlives_episode=False)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        excess = self.episode_cost(figures) - self.config.state_limit
        step = cpo_update(self.learner, batch, excess)
        return step | fit_critics(self.learner, batch)
