"""The losses, as pure functions of what they depend on. B is the number of samples in a minibatch."""

import torch
from torch import Tensor


def clipped_surrogate(ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """−E[min(r A, clip(r, 1 ± ε) A)], eq. 12.

    Args:
        ratio: r, new probability over old [B].
        advantage: A [B].
        clip: ε.

    Returns:
        Scalar to minimise.
    """
    bounded = ratio.clamp(1 - clip, 1 + clip)
    return -torch.minimum(ratio * advantage, bounded * advantage).mean()


def cost_surrogate(ratio: Tensor, cost_advantage: Tensor, multiplier: Tensor) -> Tensor:
    """E[λ(s) r A_c], the second term of eq. 14.

    Args:
        ratio: r, new probability over old [B].
        cost_advantage: A_c [B].
        multiplier: λ_ξ(s), held constant [B].

    Returns:
        Scalar to minimise.
    """
    return (multiplier * ratio * cost_advantage).mean()


def critic_loss(values: Tensor, targets: Tensor, parameters: Tensor, l2: float) -> Tensor:
    """Mean squared error of each critic plus l2 · Σ p², summed over the critics.

    Args:
        values: [K, B].
        targets: [K, B].
        parameters: [K, P].
        l2: weight of the parameters' squares.

    Returns:
        Scalar to minimise.
    """
    loss = (values - targets).square().mean(1).sum()
    return loss + l2 * parameters.square().sum() if l2 else loss


def multiplier_loss(multiplier: Tensor, cost: Tensor, state_limit: float) -> Tensor:
    """−E[λ_ξ(s_t) (C(s_t, a_t, s_{t+1}) − w)], eq. 15 with its sign turned.

    Args:
        multiplier: λ_ξ(s_t) [B].
        cost: C(s_t, a_t, s_{t+1}) [B].
        state_limit: w.

    Returns:
        Scalar to minimise.
    """
    return -(multiplier * (cost - state_limit)).mean()


def saturation_loss(mean: Tensor, edge: Tensor) -> Tensor:
    """E[Σ max(0, |μ| − edge)²]: how far the policy's mean lies where actions no longer differ.

    Args:
        mean: μ(s) [B, a].
        edge: [a].

    Returns:
        Scalar to minimise.
    """
    return (mean.abs() - edge).clamp(min=0).square().sum(1).mean()
