"""Lagnet with foresight: eq. 14 with a multiplier that knows what is coming.

Eq. 15 is linear in λ: its optimum in each state is 0 or infinity. With a penalty of a power q above 1,
max E[λ (C̄ − w) − κ λ^q / q], the optimum is bounded: λ(s) = ([C̄(s) − w]₊ / κ)^p with p = 1 / (q − 1). Here
C̄(s) is the discounted cost of the next moments, regressed by a network, so that λ rises on the approach and
not only inside a hazard; and the one scale β = κ^−p is moved until the episode cost meets its limit:
λ_ξ(s) = β C̄_ξ(s)^p. A cubic penalty, p = ½, lies between one λ for all states and the quadratic one, whose λ
grows so steeply before a hazard that a policy may rather stand still.
"""

import math

import torch
from torch import Tensor

from trainer.advantage import gae, successor_values
from trainer.algorithms.base import Algorithm
from trainer.algorithms.lagnet import statewise_update
from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.dual import Numbers, number
from trainer.learner import Batch, Learner
from trainer.rollout import Figures


class LagnetForesight(Algorithm):
    """The policy maximises eq. 14 with λ_ξ(s) = β C̄_ξ(s)^p; C̄_ξ is regressed, β follows the episode cost."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        config = self.config
        self.network = MultiplierNetwork(learner, config.foresight_init, config.foresight_learning_rate)
        self.network.scale = config.scale_init
        self.network.power = config.foresight_power

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        config = self.config
        self.network.scale = next_scale(
            self.network.scale,
            self.cost_now(figures),
            config.limit_share * config.cost_limit,
            config.scale_gain,
            config.scale_step,
        )
        loss = self._regress(batch)
        with torch.no_grad():
            multiplier = self.network(batch.observation)
        return {
            "multiplier": float(multiplier.mean()),
            "multiplier_max": float(multiplier.max()),
            "scale": self.network.scale,
            "multiplier_loss": loss,
        } | statewise_update(
            self.learner, batch, multiplier, config.rescale or "state", config.policy_step or "trust-region"
        )

    def cost_now(self, figures: Figures) -> float:
        """What an episode of the latest epoch's steps costs: without the delay of finished episodes."""
        return figures.step_cost * self.config.episode_steps

    def _regress(self, batch: Batch) -> float:
        """Passes of minibatch regression of C̄_ξ; returns the mean loss of the last one."""
        targets = self.targets(batch)

        def loss(block: slice) -> Tensor:
            return (self.network.raw(batch.observation[block]) - targets[block]).square().mean()

        return self.network.descend(batch.schedule[: self.config.foresight_passes], loss)

    def targets(self, batch: Batch) -> Tensor:
        """C̄(s_t) = Σ γ_f^k C_{t+k}, λ-returns with the network's own value at the ends [B]."""
        config, trajectory = self.config, batch.trajectory
        discount = config.per_decision(config.foresight)
        T, N = trajectory.cost.shape
        with torch.no_grad():
            seen = self.learner.inputs(trajectory.observation)
            values = self.network.raw(seen).view(T + 1, N).numpy()
            final = self.network.raw(self.learner.inputs(trajectory.final_observation)).numpy()
        after = successor_values(values, trajectory.ended, trajectory.terminated, final)
        ahead = gae(trajectory.cost, values, after, trajectory.ended, discount, config.gae)
        return torch.from_numpy((ahead + values[:-1]).reshape(-1)[batch.order])

    def multiplier_network(self) -> MultiplierNetwork:
        """λ_ξ."""
        return self.network

    def state(self) -> Numbers:
        """The scale."""
        return {"scale": self.network.scale}

    def load_state(self, state: Numbers) -> None:
        """Takes on the scale."""
        self.network.scale = number(state["scale"])


def next_scale(scale: float, cost: float, target: float, gain: float, step: float) -> float:
    """β · exp(gain (J_c − d)), the exponent within ± step: dual ascent on log β.

    Args:
        scale: β.
        cost: J_c.
        target: d, or the share of it that is aimed at.
        gain: of the excess.
        step: largest change of log β.

    Returns:
        The next β.
    """
    return scale * math.exp(max(-step, min(step, gain * (cost - target))))
