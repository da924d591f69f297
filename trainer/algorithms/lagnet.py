"""PPO-Lagnet: a Lagrange multiplier for every state (the paper, §3.3)."""

from typing import Literal

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.algorithms.ppo import proximal_update
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate, cost_surrogate, multiplier_loss
from trainer.rollout import Figures
from trainer.trust_region import trust_region_update


def statewise_update(
    learner: Learner,
    batch: Batch,
    multiplier: Tensor,
    rescale: Literal["mean", "state"],
    step: Literal["adam", "trust-region"],
) -> dict[str, float]:
    """The policy's ascent on eq. 14, rescaled, beside the critics' regression.

    Args:
        learner: whose actor and critics move.
        batch: the epoch.
        multiplier: λ_ξ(s) [B].
        rescale: "mean" divides eq. 14 as a whole by 1 + mean λ (Adam does not see a common factor, the
            gradient clip does); "state" divides each state's term by its own 1 + λ_ξ(s) σ_c, with σ_c the
            deviation of A_c (that of A is 1): this keeps the best action of every state, and keeps the few
            states of large λ from deciding the whole step.
        step: passes of Adam over minibatches as in PPO, or one natural-gradient step as in TRPO.

    Returns:
        Figures to log.
    """
    clip = learner.config.clip
    if rescale == "state":
        weight = 1 / (1 + multiplier * batch.cost_advantage.std())
    else:
        weight = 1 / (1 + multiplier.mean().expand_as(multiplier))
    advantage = weight * batch.reward_advantage
    penalty = weight * multiplier

    def loss(ratio: Tensor, block: slice) -> Tensor:
        cost = cost_surrogate(ratio, batch.cost_advantage[block], penalty[block])
        return clipped_surrogate(ratio, advantage[block], clip) + cost

    if step == "adam":
        return proximal_update(learner, batch, loss)
    return trust_region_update(learner, batch, lambda ratio: -loss(ratio, slice(None)))


class Lagnet(Algorithm):
    """The policy maximises eq. 14, the multiplier network λ_ξ = softplus(f_ξ) ascends eq. 15."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        config = self.config
        self.network = MultiplierNetwork(learner, config.multiplier_init, config.multiplier_learning_rate)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        ascent = self._ascend(batch)
        with torch.no_grad():
            multiplier = self.network(batch.observation)
        return {
            "multiplier": float(multiplier.mean()),
            "multiplier_max": float(multiplier.max()),
            "multiplier_loss": ascent,
        } | statewise_update(
            self.learner, batch, multiplier, self.config.rescale or "mean", self.config.policy_step or "adam"
        )

    def _ascend(self, batch: Batch) -> float:
        """Passes of minibatch ascent on eq. 15; returns the mean loss of the last one."""
        limit = self.config.limit_share * self.config.state_limit

        def loss(block: slice) -> Tensor:
            return multiplier_loss(self.network(batch.observation[block]), batch.cost[block], limit)

        return self.network.descend(batch.schedule[: self.config.multiplier_passes], loss)

    def multiplier_network(self) -> MultiplierNetwork:
        """λ_ξ."""
        return self.network
