"""A gymnasium wrapper for users with their own policy and loop: the filter sees every action first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from filter.barrier_filter import BarrierFilter
from filter.config import FilterConfig
from filter.result import FilterMemory, FilterResult, Mode, Row

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    Environment = gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any]


def SafetyFilter(  # noqa: N802 - it is used like the class of a wrapper, and gives one of two
    env: Environment,
    config: FilterConfig | None = None,
    hazards: Literal["given", "lidar"] = "given",
) -> Any:
    """Wrap an environment so that each action is filtered before it is sent.

    ``info["filter"]`` of each step tells what the filter did: ``action``, ``mode``, ``barrier``, ``hazard``,
    ``row`` and ``reason``, as in `FilterResult`; without the leading axis for a single environment.

    Args:
        env: a PointGoal environment, single or vector.
        config: of the filter.
        hazards: "given" takes them from the environment's ``hazards_in_body_frame``; "lidar" uses the
            observation alone.

    Returns:
        A `gymnasium.Wrapper` or `gymnasium.vector.VectorWrapper`.

    Raises:
        TypeError: if ``env`` is neither kind of environment.
        ValueError: if ``hazards`` is neither of the two, or the environment cannot give them.
    """
    import gymnasium
    from gymnasium.vector import VectorEnv, VectorWrapper

    if hazards not in ("given", "lidar"):
        raise ValueError(f"hazards must be 'given' or 'lidar', got {hazards!r}")
    if not isinstance(env, gymnasium.Env | VectorEnv):
        raise TypeError(f"not a gymnasium environment: {env!r}")
    if hazards == "given" and not hasattr(env.unwrapped, "hazards_in_body_frame"):
        raise ValueError("the environment has no hazards_in_body_frame(); use hazards='lidar'")
    core = _Core(config, env.unwrapped if hazards == "given" else None)

    class SingleSafetyFilter(gymnasium.Wrapper[Any, Any, Any, Any]):
        """One robot behind the filter."""

        def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
            """Start an episode; the filter forgets the last one."""
            observation, info = self.env.reset(**kwargs)
            core.start(np.asarray(observation)[None])
            return observation, info

        def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
            """Filter the action (2,), send it, and say in the info what was done."""
            result = core.decide(np.asarray(action, dtype=np.float64)[None])
            observation, reward, terminated, truncated, info = self.env.step(result.action[0])
            core.see(np.asarray(observation)[None])
            told = {name: value[0] for name, value in _told(result).items()}
            return observation, reward, terminated, truncated, {**info, "filter": told}

    class VectorSafetyFilter(VectorWrapper[Any, Any, Any]):
        """Many robots behind the filter."""

        def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
            """Start episodes; the filter forgets the last ones."""
            observation, info = self.env.reset(**kwargs)
            core.start(observation)
            return observation, info

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
            """Filter the actions (N, 2), send them, and say in the info what was done."""
            result = core.decide(np.asarray(actions, dtype=np.float64))
            observation, reward, terminated, truncated, info = self.env.step(result.action)
            core.see(observation, terminated | truncated)
            return observation, reward, terminated, truncated, {**info, "filter": _told(result)}

    return VectorSafetyFilter(env) if isinstance(env, VectorEnv) else SingleSafetyFilter(env)


class _Core:
    """What both wrappers share: the filter, what it remembers, and the last observation (N, 60)."""

    def __init__(self, config: FilterConfig | None, source: Any | None) -> None:
        self._filter = BarrierFilter(config)
        self._source = source
        self._memory = FilterMemory.empty(0)
        self._observation = np.empty((0, 0))

    def start(self, observation: Any) -> None:
        self._memory = FilterMemory.empty(len(observation))
        self._observation = np.array(observation, dtype=np.float64)

    def decide(self, action: Any) -> FilterResult:
        """Filter the actions (N, 2) for the state that was seen last."""
        hazards = None
        if self._source is not None:
            hazards = np.asarray(self._source.hazards_in_body_frame())
            hazards = hazards[None] if hazards.ndim == 2 else hazards
        result = self._filter.filter(self._observation, action, hazards, self._memory)
        self._memory = result.memory
        return result

    def see(self, observation: Any, ended: Any | None = None) -> None:
        """Take the next observation; where an episode ended, it is the next one's first."""
        self._observation = np.array(observation, dtype=np.float64)
        if ended is not None:
            side, plan = self._memory.side, self._memory.plan
            self._memory = FilterMemory(np.where(ended, 0, side), np.where(ended, 0, plan))


def _told(result: FilterResult) -> dict[str, Any]:
    return {
        "action": result.action,
        "mode": [Mode(mode).name.lower() for mode in result.mode],
        "barrier": result.barrier,
        "hazard": result.hazard,
        "row": [Row(row).name.lower() for row in result.row],
        "reason": result.reason,
    }
