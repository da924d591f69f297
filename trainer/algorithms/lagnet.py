"""PPO-Lagnet: a Lagrange multiplier for every state (the paper, §3.3)."""

import torch
from torch import Tensor

from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.algorithms.ppo import check_finite, proximal_update
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate, cost_surrogate, multiplier_loss
from trainer.rollout import Figures


class Lagnet:
    """The policy maximises eq. 14, the multiplier network λ_ξ = softplus(f_ξ) ascends eq. 15.

    f_ξ's last layer starts near zero with a bias that puts λ_ξ at multiplier_init in every state.
    Eq. 14 is divided by 1 + mean λ as a whole: Adam does not see a common factor, the gradient clip does.
    """

    def __init__(self, learner: Learner) -> None:
        self.learner = learner
        config = learner.config
        self.network = MultiplierNetwork(learner, config.multiplier_init, config.multiplier_learning_rate)

    def multiplier_network(self) -> MultiplierNetwork:
        """λ_ξ."""
        return self.network

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update of the multiplier network and of the policy on one epoch; returns the figures to log."""
        clip = self.learner.config.clip
        ascent = self._ascend(batch)
        with torch.no_grad():
            multiplier = self.network(batch.observation)
        average = multiplier.mean()

        def loss(ratio: Tensor, rows: Tensor) -> Tensor:
            reward = clipped_surrogate(ratio, batch.reward_advantage[rows], clip)
            cost = cost_surrogate(ratio, batch.cost_advantage[rows], multiplier[rows])
            return (reward + cost) / (1 + average)

        return {
            "multiplier": float(average),
            "multiplier_max": float(multiplier.max()),
            "multiplier_loss": ascent,
        } | proximal_update(self.learner, batch, loss)

    def _ascend(self, batch: Batch) -> float:
        """Passes of minibatch ascent on eq. 15; returns the mean loss of the last one."""
        config = self.learner.config
        mean = 0.0
        for _ in range(config.multiplier_passes):
            order = torch.from_numpy(self.learner.rng.permutation(batch.size))
            blocks = torch.split(order, config.minibatch)
            total = torch.zeros(())
            for rows in blocks:
                loss = multiplier_loss(
                    self.network(batch.observation[rows]), batch.cost[rows], config.state_limit
                )
                (gradient,) = torch.autograd.grad(loss, self.network.parameters)
                self.learner.descend("multiplier", gradient)
                total += loss.detach()
            mean = float(total) / len(blocks)
            check_finite({"multiplier loss": mean})
        return mean

    def state(self) -> dict[str, float | list[float]]:
        """Nothing beside the networks."""
        return {}

    def load_state(self, state: dict[str, float | list[float]]) -> None:
        """Nothing to take on."""
