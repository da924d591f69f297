"""PPO [Schulman 2017], and the clipped update that the algorithms built on it share."""

from collections.abc import Callable

import torch
from torch import Tensor

from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.errors import NonFiniteError
from trainer.learner import Batch, Learner
from trainer.losses import clipped_surrogate, critic_loss
from trainer.networks import kl_divergence, log_probability
from trainer.rollout import Figures

PolicyLoss = Callable[[Tensor, Tensor], Tensor]
"""(ratio [b], sample indices [b]) → scalar to minimise."""


class PPO:
    """Maximises the return; the cost is only watched."""

    def __init__(self, learner: Learner) -> None:
        self.learner = learner

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch; returns the figures to log."""
        clip = self.learner.config.clip

        def loss(ratio: Tensor, rows: Tensor) -> Tensor:
            return clipped_surrogate(ratio, batch.reward_advantage[rows], clip)

        return {"multiplier": 0.0} | proximal_update(self.learner, batch, loss)

    def multiplier_network(self) -> MultiplierNetwork | None:
        """None: there is no multiplier."""
        return None

    def state(self) -> dict[str, float | list[float]]:
        """Nothing beside the networks."""
        return {}

    def load_state(self, state: dict[str, float | list[float]]) -> None:
        """Nothing to take on."""


def proximal_update(learner: Learner, batch: Batch, policy_loss: PolicyLoss) -> dict[str, float]:
    """Passes of minibatch descent on a policy loss and on the critics' loss.

    Ends early once the policy has moved by more than kl_stop in a pass (mean over its minibatches).

    Args:
        learner: whose actor and critics move.
        batch: the epoch.
        policy_loss: of the ratio r = π_θ(a|s) / π_old(a|s) [b] and the samples' indices [b].

    Returns:
        Losses, divergence, passes taken and the policy's mean deviation.

    Raises:
        NonFiniteError: if a loss is not finite; names it.
    """
    config = learner.config
    order = torch.from_numpy(learner.rng.permutation(batch.size))
    blocks = torch.split(order, config.minibatch)
    samples = [
        (rows, batch.observation[rows], batch.action[rows], batch.log_prob[rows], batch.mean[rows],
         batch.targets[:, rows])
        for rows in blocks
    ]  # fmt: skip
    figures: dict[str, float] = {}
    for done in range(1, config.passes + 1):
        totals = torch.zeros(3)
        for i in learner.rng.permutation(len(samples)):
            rows, x, action, old, old_mean, targets = samples[i]
            mean, log_std = learner.policy(x)
            ratio = (log_probability(mean, log_std, action) - old).exp()
            actor_loss = policy_loss(ratio, rows) - config.entropy * log_std.sum()
            value_loss = critic_loss(learner.values(x), targets, learner.critics, config.critic_l2)
            actor_grad, critic_grad = torch.autograd.grad(
                actor_loss + value_loss, (learner.actor, learner.critics)
            )
            learner.descend("actor", actor_grad)
            learner.descend("critics", critic_grad)
            with torch.no_grad():
                divergence = kl_divergence(old_mean, batch.log_std, mean, log_std)
                totals += torch.stack([actor_loss, value_loss, divergence])
        policy, critic, kl = (totals / len(samples)).tolist()
        figures = {"policy_loss": policy, "critic_loss": critic, "kl": kl, "passes": float(done)}
        check_finite({"policy loss": policy, "critic loss": critic, "KL divergence": kl})
        if kl > config.kl_stop:
            break
    return figures


def check_finite(terms: dict[str, float]) -> None:
    """Refuses to go on with a term that is NaN or infinite.

    Raises:
        NonFiniteError: names the first such term.
    """
    for name, value in terms.items():
        if not torch.isfinite(torch.tensor(value)):
            raise NonFiniteError(f"the {name} became {value}")
