"""PPO [Schulman 2017], and the clipped update that the algorithms built on it share."""

from collections.abc import Callable

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.critics import check_finite, fit_critics
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate, saturation_loss
from trainer.networks import kl_divergence, log_probability
from trainer.rollout import Figures

PolicyLoss = Callable[[Tensor, slice], Tensor]
"""(ratio [b], the samples it belongs to) → scalar to minimise."""


class PPO(Algorithm):
    """Maximises the return; the cost is only watched."""

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        return {"multiplier": 0.0} | clipped_update(self.learner, batch, batch.reward_advantage)


def clipped_update(learner: Learner, batch: Batch, advantage: Tensor) -> dict[str, float]:
    """The update with PPO's clipped surrogate of an advantage [B]."""

    def loss(ratio: Tensor, block: slice) -> Tensor:
        return clipped_surrogate(ratio, advantage[block], learner.config.clip)

    return proximal_update(learner, batch, loss)


def proximal_update(learner: Learner, batch: Batch, policy_loss: PolicyLoss) -> dict[str, float]:
    """Passes of minibatch descent on a policy loss, beside the critics' regression.

    Args:
        learner: whose actor and critics move.
        batch: the epoch.
        policy_loss: of the ratio r = π_θ(a|s) / π_old(a|s) [b] and the samples it belongs to.

    Returns:
        Losses, divergence and passes taken.

    Raises:
        NonFiniteError: if a loss is not finite; names it.
    """
    return learner.side_by_side(
        lambda: improve_policy(learner, batch, policy_loss), lambda: fit_critics(learner, batch)
    )


def improve_policy(learner: Learner, batch: Batch, policy_loss: PolicyLoss) -> dict[str, float]:
    """The actor's part of proximal_update.

    Ends early once a pass has moved the policy by more than kl_stop (mean over its minibatches).
    """
    config = learner.config
    figures: dict[str, float] = {}
    for done, blocks in enumerate(batch.schedule, 1):
        totals = torch.zeros(2)
        for block in blocks:
            mean, log_std = learner.policy(batch.observation[block])
            log_prob = log_probability(mean, log_std, batch.action[block])
            ratio = (log_prob - batch.log_prob[block]).exp()
            loss = policy_loss(ratio, block) - learner.entropy * log_std.sum()
            if config.saturation:
                loss = loss + config.saturation * saturation_loss(mean, learner.edge)
            (gradient,) = torch.autograd.grad(loss, learner.actor)
            with torch.no_grad():
                divergence = kl_divergence(batch.mean[block], batch.log_std, mean, log_std)
            learner.descend("actor", gradient)
            totals += torch.stack([loss.detach(), divergence])
        policy, kl = (totals / len(blocks)).tolist()
        figures = {"policy_loss": policy, "kl": kl, "passes": float(done)}
        check_finite({"policy loss": policy, "KL divergence": kl})
        if kl > config.kl_stop:
            break
    return figures
