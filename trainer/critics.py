"""The critics' regression, which every algorithm shares."""

import torch
from torch import Tensor

from trainer.errors import NonFiniteError
from trainer.learner import Batch, Learner
from trainer.losses import critic_loss


def critic_step(learner: Learner, observation: Tensor, targets: Tensor) -> Tensor:
    """One Adam step of both critics.

    Args:
        learner: whose critics move.
        observation: normalised [B, n].
        targets: of reward and cost [2, B].

    Returns:
        The loss before the step, a scalar.
    """
    loss = critic_loss(learner.values(observation), targets, learner.critics, learner.config.critic_l2)
    (gradient,) = torch.autograd.grad(loss, learner.critics)
    learner.descend("critics", gradient)
    return loss.detach()


def fit_critics(learner: Learner, batch: Batch) -> float:
    """Passes of minibatch regression, for algorithms whose policy takes one step an epoch.

    Returns:
        The mean loss of the last pass.

    Raises:
        NonFiniteError: if it is not finite.
    """
    config = learner.config
    mean = 0.0
    for _ in range(config.passes):
        order = torch.from_numpy(learner.rng.permutation(batch.size))
        blocks = torch.split(order, config.minibatch)
        losses = [critic_step(learner, batch.observation[rows], batch.targets[:, rows]) for rows in blocks]
        mean = float(torch.stack(losses).mean())
        check_finite({"critic loss": mean})
    return mean


def check_finite(terms: dict[str, float]) -> None:
    """Refuses to go on with a term that is NaN or infinite.

    Raises:
        NonFiniteError: names the first such term.
    """
    for name, value in terms.items():
        if not abs(value) < float("inf"):
            raise NonFiniteError(f"the {name} became {value}")
