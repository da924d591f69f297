"""The critics' regression, which every algorithm shares."""

import torch

from trainer.errors import NonFiniteError
from trainer.learner import Batch, Learner
from trainer.losses import critic_loss


def fit_critics(learner: Learner, batch: Batch) -> dict[str, float]:
    """Passes of minibatch regression of the reward and the cost critic.

    Args:
        learner: whose critics move.
        batch: the epoch.

    Returns:
        The mean loss of the last pass.

    Raises:
        NonFiniteError: if it is not finite.
    """
    mean = 0.0
    for blocks in batch.schedule:
        total = torch.zeros(())
        for block in blocks:
            values = learner.values(batch.observation[block])
            loss = critic_loss(values, batch.targets[:, block], learner.critics, learner.config.critic_l2)
            (gradient,) = torch.autograd.grad(loss, learner.critics)
            learner.descend("critics", gradient)
            total += loss.detach()
        mean = float(total) / len(blocks)
        check_finite({"critic loss": mean})
    return {"critic_loss": mean}


def check_finite(terms: dict[str, float]) -> None:
    """Refuses to go on with a term that is NaN or infinite.

    Raises:
        NonFiniteError: names the first such term.
    """
    for name, value in terms.items():
        if not abs(value) < float("inf"):
            raise NonFiniteError(f"the {name} became {value}")
