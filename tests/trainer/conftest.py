"""A tiny constrained task with a known optimum, as a vector environment like pointgoal's."""

from typing import Any

import gymnasium
import numpy as np
import pytest

STEPS = 20


class TinyTask(gymnasium.vector.VectorEnv):
    """Observation x, uniform in [-1, 1] and drawn anew each step; reward 2a − a²; cost max(0, a) where x > 0.

    20 steps an episode. Without a limit, a = 1 everywhere is best: return 20, cost 10. With a cost limit d,
    a = 1 wherever x ≤ 0 (half of the steps) and, the reward being concave, a = d / 10 wherever x > 0:
    return 10 + 2d − d² / 10.
    The observation's second number is the share of the episode that is over.
    """

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 10, poison_after: int | None = None) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float64)
        self.single_action_space = gymnasium.spaces.Box(-3, 3, (1,), np.float64)
        self.poison_after = poison_after
        self.taken = 0

    def _observe(self) -> np.ndarray:
        return np.stack([self.x, self.elapsed / STEPS], 1)

    def reset(self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None):
        self.rng = np.random.default_rng(seed)
        self.elapsed = np.array((options or {}).get("elapsed_steps", np.zeros(self.num_envs, np.int64)))
        self.x = self.rng.uniform(-1, 1, self.num_envs)
        return self._observe(), {}

    def step(self, action: np.ndarray):
        a = action[:, 0].astype(float)
        cost = np.where(self.x > 0, np.maximum(0, a), 0.0)
        self.taken += 1
        if self.poison_after is not None and self.taken > self.poison_after:
            a = a * np.nan
        self.elapsed = self.elapsed + 1
        self.x = self.rng.uniform(-1, 1, self.num_envs)
        truncated = self.elapsed >= STEPS
        info = {"cost": cost}
        if truncated.any():
            info |= {"final_obs": self._observe(), "_final_obs": truncated}
            self.elapsed = np.where(truncated, 0, self.elapsed)
        return self._observe(), 2 * a - a**2, np.zeros(self.num_envs, bool), truncated, info

    def state_dict(self) -> dict[str, np.ndarray]:
        state = self.rng.bit_generator.state["state"]
        words = [
            state["state"] >> 64,
            state["state"] & (2**64 - 1),
            state["inc"] >> 64,
            state["inc"] & (2**64 - 1),
        ]
        return {"x": self.x, "elapsed": self.elapsed, "rng": np.array(words, np.uint64)}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        self.x, self.elapsed = state["x"].copy(), state["elapsed"].copy()
        words = [int(w) for w in state["rng"]]
        full = self.rng.bit_generator.state
        full["state"] = {"state": words[0] << 64 | words[1], "inc": words[2] << 64 | words[3]}
        self.rng.bit_generator.state = full


@pytest.fixture
def tiny_task():
    return TinyTask
