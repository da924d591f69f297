"""What trust-region algorithms share: Fisher products, conjugate gradients, line search, TRPO's step."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from trainer.critics import check_finite, fit_critics
from trainer.learner import Batch, Learner
from trainer.networks import kl_divergence, log_probability, mlp

Product = Callable[[Tensor], Tensor]
Objective = Callable[[Tensor], Tensor]
"""Ratio r = π_θ(a|s) / π_old(a|s) [B] → scalar to maximise."""
TRIES = 15
"""Shares of TRPO's step that the line search tries."""


def expected(advantage: Tensor) -> Objective:
    """E[r A] for an advantage [B]."""
    return lambda ratio: (ratio * advantage).mean()


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
    """What is known of a policy near the acting one.

    Attributes:
        objective: what is maximised.
        cost: E[r A_c].
        divergence: KL(old ‖ new).
    """

    objective: Tensor
    cost: Tensor
    divergence: Tensor


def surrogates(learner: Learner, batch: Batch, objective: Objective) -> Surrogates:
    """The surrogates at the learner's present actor.

    Args:
        learner: whose actor it is.
        batch: the epoch.
        objective: of the ratio.

    Returns:
        Scalars, with a graph if gradients are enabled.
    """
    mean, log_std = learner.policy(batch.observation)
    ratio = (log_probability(mean, log_std, batch.action) - batch.log_prob).exp()
    return Surrogates(
        objective=objective(ratio),
        cost=(ratio * batch.cost_advantage).mean(),
        divergence=kl_divergence(batch.mean, batch.log_std, mean, log_std),
    )


def line_search(
    learner: Learner,
    batch: Batch,
    objective: Objective,
    step: Tensor,
    accept: Callable[[Surrogates], bool],
    tries: int,
) -> tuple[float, float]:
    """Moves the actor along a step, 0.8^k of it for the first k < tries that is accepted, or not at all.

    Args:
        learner: whose actor moves.
        batch: the epoch.
        objective: of the surrogates.
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
            found = surrogates(learner, batch, objective)
            if accept(found):
                return share, float(found.divergence)
            share *= 0.8
        learner.actor.copy_(start)
    return 0.0, 0.0


def trust_region_update(learner: Learner, batch: Batch, objective: Objective) -> dict[str, float]:
    """TRPO's step up an objective of the ratio, beside the critics' regression; returns the figures of both.

    Raises:
        NonFiniteError: if a loss or the step is not finite; names it.
    """
    return learner.side_by_side(
        lambda: trust_region_step(learner, batch, objective), lambda: fit_critics(learner, batch)
    )


def trust_region_step(learner: Learner, batch: Batch, objective: Objective) -> dict[str, float]:
    """TRPO's step √(2δ / xᵀHx) x with H x = g, shortened until the objective rises within the trust region.

    Args:
        learner: whose actor moves.
        batch: the epoch.
        objective: of the ratio; g is its gradient.

    Returns:
        Loss before the step, share of the step taken and divergence.

    Raises:
        NonFiniteError: if the objective or the step is not finite.
    """
    config = learner.config
    start = surrogates(learner, batch, objective).objective
    (g,) = torch.autograd.grad(start, learner.actor)
    before = start.item()
    product = fisher(learner, batch)
    x = conjugate_gradient(product, g, config.cg_iterations)
    curvature = x @ product(x)
    step = (2 * config.trust_kl / (curvature + 1e-8)).sqrt() * x
    check_finite({"policy surrogate": before, "trust-region step": float(step.sum())})

    def accept(found: Surrogates) -> bool:
        return bool(found.objective >= before) and bool(found.divergence <= config.trust_kl)

    share, kl = line_search(learner, batch, objective, step, accept, TRIES)
    return {"policy_loss": -before, "step_share": share, "kl": kl}
