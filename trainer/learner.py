"""What every algorithm learns with: the parameters, their optimisers and the epoch's batch."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from trainer.actions import ActionRange
from trainer.advantage import gae, successor_values
from trainer.config import Config
from trainer.errors import CheckpointError, NonFiniteError
from trainer.features import Features, surroundings
from trainer.networks import Shape, fast_mlp, gaussian, initial, log_probability
from trainer.rollout import Trajectory

ADAM = ("step", "exp_avg", "exp_avg_sq")
Figures = dict[str, float]
SETTLING = (0.5, 0.9)
"""Shares of the run between which the largest noise falls: the last tenth shows nearly what is exported."""
REWARD, COST = 0, 1
"""Rows of the critics' parameters."""


@dataclass
class Batch:
    """One epoch as samples in random order, B = T · N.

    Attributes:
        observation: the networks' inputs [B, m].
        action: [B, a].
        mean: the acting policy's mean action [B, a].
        log_std: its log standard deviation [a].
        log_prob: its log density of the action [B].
        reward_advantage: A, mean 0 and deviation 1 [B].
        cost_advantage: A_c, mean 0, its own scale kept [B].
        targets: of the reward critic and the cost critic [2, B].
        cost: C(s, a, s'), a control step's mean over the decision [B].
        order: where each sample stands in the trajectory's row-major order [B].
        trajectory: what the samples come from.
        schedule: for each pass, the minibatches in the order they are taken, each a slice of the samples.
    """

    observation: Tensor
    action: Tensor
    mean: Tensor
    log_std: Tensor
    log_prob: Tensor
    reward_advantage: Tensor
    cost_advantage: Tensor
    targets: Tensor
    cost: Tensor
    order: npt.NDArray[np.int64]
    trajectory: Trajectory
    schedule: list[list[slice]]


class Learner:
    """Actor, both critics and their features, with their optimisers.

    Attributes:
        actor: parameters of the Gaussian policy [P + a].
        critics: parameters of the reward and the cost critic [2, P'].
        actor_shape: layer sizes of the actor's network.
        critic_shape: layer sizes of the critics, and of a multiplier network.
        edge: where the policy's draws saturate [a].
        entropy: weight of the entropy bonus in this epoch.
    """

    def __init__(
        self, config: Config, observations: int, actions: ActionRange, rng: np.random.Generator
    ) -> None:
        self.config = config
        self.edge = torch.from_numpy(actions.edge)
        self.rng = rng
        self.entropy = config.entropy
        self.features = Features(observations, surroundings(config))
        self.actor_shape = Shape(self.features.size, len(actions.unit))
        self.critic_shape = Shape(self.features.size, 1)
        log_std = torch.full((len(actions.unit),), config.initial_log_std)
        actor = torch.cat([initial(self.actor_shape, rng, 0.01), log_std])
        critics = torch.stack([initial(self.critic_shape, rng, 0.1) for _ in (REWARD, COST)])
        self.parameters: dict[str, Tensor] = {}
        self.optimisers: dict[str, torch.optim.Adam] = {}
        self.actor = self.add("actor", actor, config.learning_rate)
        self.critics = self.add("critics", critics, config.critic_learning_rate)
        # One thread a job: jobs this small lose more to waiting for each other than they gain.
        self._pool = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,))

    def add(self, name: str, parameters: Tensor, learning_rate: float) -> Tensor:
        """Registers parameters to be optimised by Adam and kept in checkpoints."""
        leaf = parameters.clone().requires_grad_()
        self.parameters[name] = leaf
        self.optimisers[name] = torch.optim.Adam([leaf], lr=learning_rate, fused=True)
        return leaf

    def descend(self, name: str, gradient: Tensor) -> None:
        """One Adam step of the named parameters along a gradient, clipped to the configured norm."""
        parameters, optimiser = self.parameters[name], self.optimisers[name]
        norm = gradient.norm()
        parameters.grad = gradient * (self.config.gradient_clip / norm.clamp(min=self.config.gradient_clip))
        optimiser.step()

    def start_epoch(self, progress: float) -> None:
        """Sets step size, entropy bonus and largest noise for the share of the run that is done [0, 1)."""
        config = self.config
        first, last = config.initial_log_std, min(config.initial_log_std, config.final_log_std)
        settled = min(1.0, max(0.0, (progress - SETTLING[0]) / (SETTLING[1] - SETTLING[0])))
        with torch.no_grad():
            self.actor[self.actor_shape.size :].clamp_(max=first + (last - first) * settled)
        self.entropy = config.entropy * (1 - progress)
        self.optimisers["actor"].param_groups[0]["lr"] = config.learning_rate * (1 - progress)

    def policy(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean [B, a] and log standard deviation [a] for the networks' inputs [B, m]."""
        return gaussian(self.actor, observation, self.actor_shape)

    def values(self, observation: Tensor) -> Tensor:
        """Reward and cost values [2, B] for the networks' inputs [B, m]."""
        return torch.stack([fast_mlp(row, observation, self.critic_shape)[:, 0] for row in self.critics])

    def batch(self, trajectory: Trajectory, cost_discount: float, cost_outlives_episode: bool) -> Batch:
        """Turns a trajectory into samples with advantages and targets.

        Args:
            trajectory: one epoch.
            cost_discount: γ of the cost, a decision.
            cost_outlives_episode: whether a time limit leaves the cost's value at the final observation; the
                reward's it always does.

        Returns:
            The batch.

        Raises:
            NonFiniteError: if an observation, a reward or a cost is not finite.
        """
        for name in ("observation", "reward", "cost"):
            if not np.isfinite(getattr(trajectory, name)).all():
                raise NonFiniteError(f"the environment returned a {name} that is not finite")
        T, N = trajectory.reward.shape
        config = self.config
        with torch.no_grad():
            seen = self.inputs(trajectory.observation)
            values = self.values(seen).view(2, T + 1, N).numpy()
            final_values = self.values(self.inputs(trajectory.final_observation)).numpy()
        order = self.rng.permutation(T * N)
        rows = torch.from_numpy(order)
        advantages, targets = [], []
        ended, terminated = trajectory.ended, trajectory.terminated
        for k, signal, discount, smoothing, over in (
            (REWARD, trajectory.reward, config.per_decision(config.discount), config.gae, terminated),
            (
                COST,
                trajectory.cost,
                cost_discount,
                config.cost_gae,
                terminated if cost_outlives_episode else ended,
            ),
        ):
            after = successor_values(values[k], ended, over, final_values[k])
            advantage = gae(signal, values[k], after, ended, discount, smoothing)
            advantages.append(torch.from_numpy(advantage.reshape(-1)[order]))
            targets.append(torch.from_numpy((advantage + values[k][:-1]).reshape(-1)[order]))
        reward_advantage, cost_advantage = advantages
        action, mean = _flat(trajectory.action)[rows], _flat(trajectory.mean)[rows]
        log_std = self.actor.detach()[self.actor_shape.size :].clone()
        return Batch(
            observation=seen[rows],
            action=action,
            mean=mean,
            log_std=log_std,
            log_prob=log_probability(mean, log_std, action),
            reward_advantage=(reward_advantage - reward_advantage.mean()) / (reward_advantage.std() + 1e-8),
            cost_advantage=cost_advantage - cost_advantage.mean(),
            targets=torch.stack(targets),
            cost=torch.from_numpy(trajectory.cost.reshape(-1)[order] / np.float32(config.action_repeat)),
            order=order,
            trajectory=trajectory,
            schedule=self._schedule(T * N),
        )

    def _schedule(self, samples: int) -> list[list[slice]]:
        """The minibatches of each pass, drawn at once so that jobs side by side share them."""
        size = self.config.minibatch
        blocks = [slice(start, start + size) for start in range(0, samples, size)]
        return [[blocks[i] for i in self.rng.permutation(len(blocks))] for _ in range(self.config.passes)]

    def side_by_side(self, first: Callable[[], Figures], second: Callable[[], Figures]) -> Figures:
        """Runs two jobs that share no parameters, on two threads if the run has them.

        The result does not depend on the number of threads.

        Args:
            first: a job that returns figures to log.
            second: another.

        Returns:
            The figures of both.
        """
        if self.config.threads == 1:
            return first() | second()
        pending = self._pool.submit(second)
        return first() | pending.result()

    def inputs(self, observation: npt.NDArray[np.float32]) -> Tensor:
        """Raw observations [..., n] → the networks' inputs [B, m]."""
        with torch.no_grad():
            result: Tensor = self.features(_flat(observation))
        return result

    def state_dict(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays from which load_state_dict goes on bit for bit."""
        state: dict[str, npt.NDArray[Any]] = {
            "normaliser.mean": self.features.normaliser.mean,
            "normaliser.variance": self.features.normaliser.variance,
            "normaliser.count": np.asarray(self.features.normaliser.count),
        }
        for name, parameters in self.parameters.items():
            state[name] = parameters.detach().numpy()
            for key in ADAM:
                moments = self.optimisers[name].state[parameters]
                state[f"adam.{name}.{key}"] = moments[key].numpy() if moments else np.zeros(0, np.float32)
        return state

    def load_state_dict(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Takes on a state that state_dict returned.

        Raises:
            CheckpointError: if a tensor is missing or has another shape.
        """
        for name, parameters in self.parameters.items():
            found = state.get(name)
            if found is None or found.shape != tuple(parameters.shape):
                shape = None if found is None else found.shape
                raise CheckpointError(
                    f"the checkpoint's {name!r} has shape {shape}, this run's {tuple(parameters.shape)}"
                )
        for name, parameters in self.parameters.items():
            with torch.no_grad():
                parameters.copy_(torch.from_numpy(state[name].copy()))
            if state[f"adam.{name}.step"].size:
                self.optimisers[name].state[parameters] = {
                    key: torch.from_numpy(state[f"adam.{name}.{key}"].copy()) for key in ADAM
                }
        self.features.normaliser.restore(
            state["normaliser.mean"].copy(),
            state["normaliser.variance"].copy(),
            float(state["normaliser.count"]),
        )


def _flat(array: npt.NDArray[np.float32]) -> Tensor:
    """[..., k] → tensor [B, k]."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32).reshape(-1, array.shape[-1]))
