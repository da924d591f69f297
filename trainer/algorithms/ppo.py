"""PPO [Schulman 2017], and the clipped update that the algorithms built on it share."""

from collections.abc import Callable

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.critics import check_finite, critic_step
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate
from trainer.networks import kl_divergence, log_probability
from trainer.rollout import Figures

PolicyLoss = Callable[[Tensor, Tensor], Tensor]
"""(ratio [b], sample indices [b]) → scalar to minimise."""


class PPO(Algorithm):
    """Maximises the return; the cost is only watched."""

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        return {"multiplier": 0.0} | clipped_update(self.learner, batch, batch.reward_advantage)


def clipped_update(learner: Learner, batch: Batch, advantage: Tensor) -> dict[str, float]:
    """proximal_update with PPO's clipped surrogate of an advantage [B]."""

    def loss(ratio: Tensor, rows: Tensor) -> Tensor:
        return clipped_surrogate(ratio, advantage[rows], learner.config.clip)

    return proximal_update(learner, batch, loss)


def proximal_update(learner: Learner, batch: Batch, policy_loss: PolicyLoss) -> dict[str, float]:
    """Passes of minibatch descent on a policy loss and on the critics' loss.

    Ends early once the policy has moved by more than kl_stop in a pass (mean over its minibatches).

    Args:
        learner: whose actor and critics move.
        batch: the epoch.
        policy_loss: of the ratio r = π_θ(a|s) / π_old(a|s) [b] and the samples' indices [b].

    Returns:
        Losses, divergence and passes taken.

    Raises:
        NonFiniteError: if a loss is not finite; names it.
    """
    config = learner.config
    order = torch.from_numpy(learner.rng.permutation(batch.size))
    blocks = [
        (
            rows,
            batch.observation[rows],
            batch.action[rows],
            batch.log_prob[rows],
            batch.mean[rows],
            batch.targets[:, rows],
        )
        for rows in torch.split(order, config.minibatch)
    ]
    figures: dict[str, float] = {}
    for done in range(1, config.passes + 1):
        totals = torch.zeros(3)
        for i in learner.rng.permutation(len(blocks)):
            rows, x, action, old, old_mean, targets = blocks[i]
            mean, log_std = learner.policy(x)
            ratio = (log_probability(mean, log_std, action) - old).exp()
            loss = policy_loss(ratio, rows) - config.entropy * log_std.sum()
            (gradient,) = torch.autograd.grad(loss, learner.actor)
            with torch.no_grad():
                divergence = kl_divergence(old_mean, batch.log_std, mean, log_std)
            learner.descend("actor", gradient)
            totals += torch.stack([loss.detach(), critic_step(learner, x, targets), divergence])
        policy, critic, kl = (totals / len(blocks)).tolist()
        figures = {"policy_loss": policy, "critic_loss": critic, "kl": kl, "passes": float(done)}
        check_finite({"policy loss": policy, "critic loss": critic, "KL divergence": kl})
        if kl > config.kl_stop:
            break
    return figures
