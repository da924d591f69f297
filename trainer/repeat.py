"""Decisions that last several control steps."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper

SUMMED = ("cost", "task_cost")


class Repeat(VectorWrapper):
    """Holds each action for `count` control steps; reward and costs add up over them.

    Exploration noise that changes 50 times a second averages out before it has moved the robot, and the
    advantage of any one draw drowns in the rest. Held for a tenth of a second, a draw has an effect worth
    learning from, and an epoch has fewer decisions to learn from, which cost less. What comes after an
    episode's end within a decision is not counted.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], count: int) -> None:
        super().__init__(env)
        self.count = count

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[Any, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]]:
        """Steps all episodes `count` times with the same actions."""
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.bool_)
        result: dict[str, Any] = {}
        for _ in range(self.count):
            going = ~(terminated | truncated)
            observation, r, over, out, info = self.env.step(actions)
            reward += np.where(going, r, 0.0)
            for name in SUMMED:
                if name in info:
                    result[name] = result.get(name, 0.0) + np.where(going, info[name], 0.0)
            ended = going & (over | out)
            if ended.any():
                final = result.setdefault("final_obs", np.zeros_like(observation))
                final[ended] = np.stack(list(info["final_obs"][ended]))
            terminated |= going & over
            truncated |= going & out
        result["_final_obs"] = terminated | truncated
        return observation, reward, terminated, truncated, result

    def state_dict(self) -> dict[str, npt.NDArray[Any]]:
        """The environment's; a decision leaves nothing behind."""
        env: Any = self.env
        state: dict[str, npt.NDArray[Any]] = env.state_dict()
        return state

    def load_state_dict(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Takes on a state that state_dict returned."""
        env: Any = self.env
        env.load_state_dict(state)
