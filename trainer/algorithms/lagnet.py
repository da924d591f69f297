"""PPO-Lagnet: a Lagrange multiplier for every state (the paper, §3.3)."""

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.algorithms.ppo import proximal_update
from trainer.critics import check_finite
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate, cost_surrogate, multiplier_loss
from trainer.rollout import Figures


def statewise_update(learner: Learner, batch: Batch, multiplier: Tensor) -> dict[str, float]:
    """proximal_update with eq. 14 for multipliers λ_ξ(s) [B].

    Eq. 14 is divided by 1 + mean λ as a whole: Adam does not see a common factor, the gradient clip does.
    """
    clip = learner.config.clip
    whole = 1 + multiplier.mean()

    def loss(ratio: Tensor, rows: Tensor) -> Tensor:
        reward = clipped_surrogate(ratio, batch.reward_advantage[rows], clip)
        cost = cost_surrogate(ratio, batch.cost_advantage[rows], multiplier[rows])
        return (reward + cost) / whole

    return proximal_update(learner, batch, loss)


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
        } | statewise_update(self.learner, batch, multiplier)

    def _ascend(self, batch: Batch) -> float:
        """Passes of minibatch ascent on eq. 15; returns the mean loss of the last one."""
        config = self.config
        mean = 0.0
        for _ in range(config.multiplier_passes):
            order = torch.from_numpy(self.learner.rng.permutation(batch.size))
            losses = []
            for rows in torch.split(order, config.minibatch):
                multiplier = self.network(batch.observation[rows])
                loss = multiplier_loss(multiplier, batch.cost[rows], config.state_limit)
                (gradient,) = torch.autograd.grad(loss, self.network.parameters)
                self.learner.descend("multiplier", gradient)
                losses.append(loss.detach())
            mean = float(torch.stack(losses).mean())
            check_finite({"multiplier loss": mean})
        return mean

    def multiplier_network(self) -> MultiplierNetwork:
        """λ_ξ."""
        return self.network
