"""A gymnasium wrapper for users with their own policy and loop: the filter sees every action first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from decision import MEMORY, Decisions
from filter.barrier_filter import BarrierFilter, Guide
from filter.config import FilterConfig

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    Environment = gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any]

_HARMLESS = {"OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo", "TimeLimit"}
"""Wrappers of gymnasium that leave observations and actions as they are."""
_TOLD = ("action", "mode", "origin", "barrier", "hazard", "reason")


def SafetyFilter(  # noqa: N802 - it is used like the class of a wrapper, and gives one of two
    env: Environment,
    config: FilterConfig | None = None,
    hazards: Literal["given", "lidar"] = "given",
    guide: Guide | None = None,
) -> Any:
    """Wrap an environment so that each action is filtered before it is sent.

    ``info["filter"]`` of each step tells what the filter did: ``action``, ``mode``, ``origin``, ``barrier``,
    ``hazard`` and ``reason``, as in `decision.Decisions`; without the leading axis for a single environment.

    Args:
        env: a PointGoal environment, single or vector. Wrappers that change observations or actions go round
            this one, not into it: the filter takes what it sees and sends for the robot's own.
        config: of the filter.
        hazards: "given" takes them from the environment's ``hazards_in_body_frame``; "lidar" uses the
            observation alone.
        guide: who leads the robot round what is in its way; None: nobody does.

    Raises:
        TypeError: if ``env`` is neither kind of environment.
        ValueError: if ``hazards`` is neither of the two, the environment cannot give them, or a wrapper in it
            may change observations or actions.
    """
    import gymnasium
    from gymnasium.vector import VectorEnv, VectorWrapper

    if hazards not in ("given", "lidar"):
        raise ValueError(f"hazards must be 'given' or 'lidar', got {hazards!r}")
    if not isinstance(env, gymnasium.Env | VectorEnv):
        raise TypeError(f"not a gymnasium environment: {env!r}")
    if hazards == "given" and not hasattr(env.unwrapped, "hazards_in_body_frame"):
        raise ValueError("the environment has no hazards_in_body_frame(); use hazards='lidar'")
    _refuse_wrappers(env)
    core = _Core(BarrierFilter(config, guide), env.unwrapped if hazards == "given" else None)

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
            told = {name: getattr(result[0], name) for name in _TOLD}
            return observation, reward, terminated, truncated, {**info, "filter": told}

    class VectorSafetyFilter(VectorWrapper[Any, Any, Any]):
        """Many robots behind the filter."""

        def reset(
            self, *, seed: Any = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            """Start episodes, of the rows in ``options["reset_mask"]`` or all; the filter forgets theirs."""
            observation, info = self.env.reset(seed=seed, options=options)
            core.start(observation, None if options is None else options.get("reset_mask"))
            return observation, info

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
            """Filter the actions (N, 2), send them, and say in the info what was done."""
            result = core.decide(np.asarray(actions, dtype=np.float64))
            observation, reward, terminated, truncated, info = self.env.step(result.action)
            core.see(observation, terminated | truncated)
            told = {name: getattr(result, name) for name in _TOLD}
            return observation, reward, terminated, truncated, {**info, "filter": told}

    return VectorSafetyFilter(env) if isinstance(env, VectorEnv) else SingleSafetyFilter(env)


def _refuse_wrappers(env: Any) -> None:
    """Raise ValueError for a wrapper that may change what the robot sees or does."""
    while env is not env.unwrapped:
        name = type(env).__name__
        if name not in _HARMLESS or not type(env).__module__.startswith("gymnasium."):
            raise ValueError(
                f"{name} may change observations or actions, which the filter must see as the robot's own: "
                f"wrap the other way round, {name}(SafetyFilter(env))"
            )
        env = env.env


class _Core:
    """What both wrappers share: the filter, what it remembers, and the last observation (N, 60)."""

    def __init__(self, robot_filter: BarrierFilter, source: Any | None) -> None:
        self._filter = robot_filter
        self._source = source
        self._memory = np.zeros(0, MEMORY)
        self._observation = np.empty((0, 0))

    def start(self, observation: Any, which: Any | None = None) -> None:
        """Forget the robots of some rows (N,), of all for None."""
        self.see(observation, np.ones(len(observation), np.bool_) if which is None else np.asarray(which))

    def decide(self, action: Any) -> Decisions:
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
        if len(self._memory) != len(observation):
            self._memory = np.zeros(len(observation), MEMORY)
        if ended is not None:
            self._memory[ended] = np.zeros(1, MEMORY)
