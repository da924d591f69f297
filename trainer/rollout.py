"""Rollouts: many environments side by side, a fixed number of steps at a time."""

from collections import deque
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.vector import VectorEnv

from pointgoal import seeds
from pointgoal.seeds import Use
from trainer.actions import ActionRange
from trainer.config import Config
from trainer.features import Features
from trainer.networks import Shape, mlp
from trainer.report import TAIL

Floats = npt.NDArray[np.float32]
RECENT = 100
"""Episodes that J_c, the undiscounted episode cost, is averaged over (as in OmniSafe)."""


@dataclass
class Trajectory:
    """One epoch of experience: T decisions of N environments.

    Attributes:
        observation: raw observations, the one after the last step included [T + 1, N, n].
        action: the policy's draws, before they are scaled and clipped [T, N, a].
        mean: their mean [T, N, a].
        reward: [T, N].
        cost: the cost that is constrained [T, N].
        ended: whether an episode ended with the step [T, N].
        terminated: whether it ended in a terminal state, not by its time limit [T, N].
        final_observation: raw last observation of each True of `ended`, in row-major order [E, n].
    """

    observation: Floats
    action: Floats
    mean: Floats
    reward: Floats
    cost: Floats
    ended: npt.NDArray[np.bool_]
    terminated: npt.NDArray[np.bool_]
    final_observation: Floats


@dataclass
class Figures:
    """Undiscounted figures of whole episodes, the latest last.

    Attributes:
        returns: return of each of the last 500 episodes.
        costs: cost of each of them, as the task has it.
        constrained: what the algorithm constrains in each of them; differs from the cost under SCPO.
        lengths: steps of each of them.
        total: episodes ended since the run began.
        fresh: how many of them ended in the latest epoch.
        step_cost: mean cost of a control step in the latest epoch.
    """

    returns: deque[float] = field(default_factory=lambda: deque(maxlen=TAIL))
    costs: deque[float] = field(default_factory=lambda: deque(maxlen=TAIL))
    constrained: deque[float] = field(default_factory=lambda: deque(maxlen=TAIL))
    lengths: deque[float] = field(default_factory=lambda: deque(maxlen=TAIL))
    total: int = 0
    fresh: int = 0
    step_cost: float = 0.0

    @property
    def episode_cost(self) -> float | None:
        """J_c: mean constrained cost of the last 100 episodes, None before the first one has ended."""
        return mean(list(self.constrained)[-RECENT:])


def mean(values: list[float]) -> float | None:
    """The mean, or None of nothing."""
    return float(np.mean(values)) if values else None


class Rollout:
    """Steps a vector environment (autoreset in the same step) with a Gaussian policy.

    Episodes start staggered, so that the environments do not all end theirs in the same step. A first
    episode that began late is cut short; it trains, but is not counted in the figures.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        config: Config,
        noise: np.random.Generator,
        actions: ActionRange,
    ) -> None:
        self.env = env
        self.config = config
        self.noise = noise
        self.figures = Figures()
        self.seconds = {"simulation": 0.0, "inference": 0.0}
        self.actions = actions
        elapsed = np.arange(env.num_envs) * config.episode_steps // env.num_envs
        elapsed -= elapsed % config.action_repeat
        seeded: Any = env  # gymnasium types the seed as one number, its vector environments take one a row
        layouts = seeds.rows(Use.TRAINING, config.seed, env.num_envs)
        observation, _ = seeded.reset(seed=layouts, options={"elapsed_steps": elapsed})
        self._observation = np.asarray(observation, np.float32)
        self._return = np.zeros(env.num_envs)
        self._cost = np.zeros(env.num_envs)
        self._constrained = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs)
        self._whole = elapsed == 0

    @torch.inference_mode()
    def collect(self, actor: Floats, shape: Shape, features: Features) -> Trajectory:
        """Gathers one epoch with the policy held fixed.

        Args:
            actor: the actor's parameters [P + a], see networks.gaussian.
            shape: its layer sizes.
            features: of the observations; not changed.

        Returns:
            The trajectory; self.figures has taken in the episodes that ended on the way.
        """
        T, N, a = self.config.horizon, self.env.num_envs, shape.outputs
        n = self._observation.shape[1]
        theta = torch.from_numpy(actor[: shape.size])
        out = Trajectory(
            observation=np.empty((T + 1, N, n), np.float32),
            action=np.empty((T, N, a), np.float32),
            mean=np.empty((T, N, a), np.float32),
            reward=np.empty((T, N), np.float32),
            cost=np.empty((T, N), np.float32),
            ended=np.zeros((T, N), np.bool_),
            terminated=np.zeros((T, N), np.bool_),
            final_observation=np.empty((0, n), np.float32),
        )
        noise = self.noise.standard_normal((T, N, a), np.float32) * np.exp(actor[shape.size :])
        final: list[npt.NDArray[Any]] = []
        fresh = self.figures.total
        clock = perf_counter()
        for t in range(T):
            out.observation[t] = self._observation
            out.mean[t] = mlp(theta, features(torch.from_numpy(out.observation[t])), shape).numpy()
            np.add(out.mean[t], noise[t], out=out.action[t])
            sent = self.actions.sent(torch.from_numpy(out.action[t])).numpy()
            now = perf_counter()
            self.seconds["inference"] += now - clock
            observation, reward, terminated, truncated, info = self.env.step(sent)
            clock = perf_counter()
            self.seconds["simulation"] += clock - now
            out.reward[t], out.cost[t] = reward, info["cost"]
            self._observation = observation
            ended = terminated | truncated
            self._return += reward
            self._cost += info.get("task_cost", info["cost"])
            self._constrained += info["cost"]
            self._length += self.config.action_repeat
            if ended.any():
                out.ended[t], out.terminated[t] = ended, terminated
                final.append(np.asarray(info["final_obs"][ended], np.float32))
                self._close(ended)
        out.observation[T] = self._observation
        out.final_observation = np.concatenate([out.final_observation, *final])
        self.figures.fresh = self.figures.total - fresh
        self.figures.step_cost = float(out.cost.mean(dtype=np.float64)) / self.config.action_repeat
        return out

    def _close(self, ended: npt.NDArray[np.bool_]) -> None:
        """Books the episodes that have just ended and opens the next ones."""
        for i in np.flatnonzero(ended & self._whole):
            self.figures.returns.append(float(self._return[i]))
            self.figures.costs.append(float(self._cost[i]))
            self.figures.constrained.append(float(self._constrained[i]))
            self.figures.lengths.append(float(self._length[i]))
            self.figures.total += 1
        self._return[ended] = 0.0
        self._cost[ended] = 0.0
        self._constrained[ended] = 0.0
        self._length[ended] = 0.0
        self._whole[ended] = True

    def state_dict(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays from which load_state_dict goes on bit for bit; the noise generator is its owner's."""
        env: Any = self.env
        figures = self.figures
        return {
            **{f"env.{name}": np.asarray(value) for name, value in env.state_dict().items()},
            "observation": self._observation,
            "return": self._return,
            "cost": self._cost,
            "constrained": self._constrained,
            "length": self._length,
            "whole": self._whole,
            "figures.returns": np.asarray(figures.returns, np.float64),
            "figures.costs": np.asarray(figures.costs, np.float64),
            "figures.constrained": np.asarray(figures.constrained, np.float64),
            "figures.lengths": np.asarray(figures.lengths, np.float64),
            "figures.total": np.asarray(figures.total, np.int64),
        }

    def load_state_dict(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Takes on a state that state_dict returned.

        Raises:
            ValueError: if it is of another number of environments or another task.
        """
        found = state["observation"].shape
        if found != self._observation.shape:
            raise ValueError(f"its observations have shape {found}, this run's {self._observation.shape}")
        env: Any = self.env
        env.load_state_dict({k.removeprefix("env."): v for k, v in state.items() if k.startswith("env.")})
        self._observation = state["observation"].copy()
        self._return = state["return"].copy()
        self._cost = state["cost"].copy()
        self._constrained = state["constrained"].copy()
        self._length = state["length"].copy()
        self._whole = state["whole"].copy()
        self.figures = Figures(
            returns=deque(state["figures.returns"].tolist(), maxlen=TAIL),
            costs=deque(state["figures.costs"].tolist(), maxlen=TAIL),
            constrained=deque(state["figures.constrained"].tolist(), maxlen=TAIL),
            lengths=deque(state["figures.lengths"].tolist(), maxlen=TAIL),
            total=int(state["figures.total"]),
        )
