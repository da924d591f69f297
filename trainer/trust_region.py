"""What the trust-region algorithms share: Fisher products, conjugate gradients, the line search."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from trainer.learner import Batch, Learner
from trainer.networks import kl_divergence, log_probability, mlp

Product = Callable[[Tensor], Tensor]


def fisher(learner: Learner, batch: Batch) -> Product:
    """The product v ↦ (H + damping · 1) v with H the Hessian of KL(old ‖ new) at the acting policy.

    At equality of both policies that Hessian is the Fisher information. One graph of the divergence's
    gradient serves all products.

    Args:
        learner: whose actor it is.
        batch: of its observations every `fisher_every`-th is used.

    Returns:
        The product, of vectors [P].
    """
    config = learner.config
    theta = learner.actor
    observation = batch.observation[:: config.fisher_every]
    shape = learner.actor_shape
    mean, log_std = mlp(theta[: shape.size], observation, shape), theta[shape.size :]
    divergence = kl_divergence(mean.detach(), log_std.detach(), mean, log_std)
    (gradient,) = torch.autograd.grad(divergence, theta, create_graph=True)

    def product(vector: Tensor) -> Tensor:
        (result,) = torch.autograd.grad(gradient @ vector, theta, retain_graph=True)
        return result + config.damping * vector

    return product


def conjugate_gradient(product: Product, b: Tensor, iterations: int, tolerance: float = 1e-10) -> Tensor:
    """Solves H x = b for a symmetric positive definite H that is known by its products.

    Args:
        product: v ↦ H v.
        b: right-hand side [P].
        iterations: at most this many products.
        tolerance: ends early at this norm of the residual.

    Returns:
        x [P].
    """
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    square = residual @ residual
    for _ in range(iterations):
        if square.sqrt() <= tolerance:
            break
        image = product(direction)
        step = square / (direction @ image)
        x += step * direction
        residual -= step * image
        following = residual @ residual
        direction = residual + (following / square) * direction
        square = following
    return x


@dataclass(frozen=True)
class Surrogates:
    """First-order models of return and cost around the acting policy.

    Attributes:
        reward: E[r A].
        cost: E[r A_c].
        divergence: KL(old ‖ new).
    """

    reward: Tensor
    cost: Tensor
    divergence: Tensor


def surrogates(learner: Learner, batch: Batch, advantage: Tensor) -> Surrogates:
    """The surrogates at the learner's present actor.

    Args:
        learner: whose actor it is.
        batch: the epoch.
        advantage: A, of the reward or a combination [B].

    Returns:
        Scalars, with a graph if gradients are enabled.
    """
    mean, log_std = learner.policy(batch.observation)
    ratio = (log_probability(mean, log_std, batch.action) - batch.log_prob).exp()
    return Surrogates(
        reward=(ratio * advantage).mean(),
        cost=(ratio * batch.cost_advantage).mean(),
        divergence=kl_divergence(batch.mean, batch.log_std, mean, log_std),
    )


def line_search(
    learner: Learner,
    batch: Batch,
    advantage: Tensor,
    step: Tensor,
    accept: Callable[[Surrogates], bool],
    tries: int,
) -> tuple[float, float]:
    """Moves the actor along a step, 0.8^k of it for the first k < tries that is accepted, or not at all.

    Args:
        learner: whose actor moves.
        batch: the epoch.
        advantage: A of the surrogates [B].
        step: the full step [P].
        accept: judges the surrogates at a candidate.
        tries: of shares of the step.

    Returns:
        The accepted share (0 for none) and the divergence there.
    """
    start = learner.actor.detach().clone()
    share = 1.0
    with torch.no_grad():
        for _ in range(tries):
            learner.actor.copy_(start + share * step)
            found = surrogates(learner, batch, advantage)
            if accept(found):
                return share, float(found.divergence)
            share *= 0.8
        learner.actor.copy_(start)
    return 0.0, 0.0
