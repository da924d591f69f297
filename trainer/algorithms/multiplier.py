"""The multiplier network λ_ξ(s)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import softplus

from trainer.critics import check_finite
from trainer.learner import Learner
from trainer.networks import Shape, fast_mlp, initial

Network = Callable[[Tensor, Tensor, Shape], Tensor]
"""networks.mlp, or what computes the same."""


class MultiplierNetwork:
    """λ_ξ(s) = scale · softplus(f_ξ(s))^power ≥ 0, registered with the learner under the name "multiplier".

    f_ξ's last layer starts near zero, with a bias that puts the softplus at `start` in every state.

    Attributes:
        parameters: ξ [P].
        scale: the factor; 1 unless an algorithm moves it.
        power: the exponent; 1 unless an algorithm sets it.
    """

    def __init__(self, learner: Learner, start: float, learning_rate: float) -> None:
        self._learner = learner
        self._shape = learner.critic_shape
        xi = initial(self._shape, learner.rng, 0.01)
        xi[-1] = start + math.log(-math.expm1(-start)) if start > 0 else -20.0
        self.parameters = learner.add("multiplier", xi, learning_rate)
        self.scale = 1.0
        self.power = 1.0

    def raw(self, observation: Tensor, network: Network = fast_mlp) -> Tensor:
        """softplus(f_ξ(s)) [B] for the networks' inputs [B, m]."""
        parameters = self.parameters.to(observation.dtype)
        return softplus(network(parameters, observation, self._shape)[:, 0])

    def __call__(self, observation: Tensor, network: Network = fast_mlp) -> Tensor:
        """λ_ξ(s) [B] for the networks' inputs [B, m]."""
        return self.scale * self.raw(observation, network) ** self.power

    def descend(self, schedule: list[list[slice]], loss: Callable[[slice], Tensor]) -> float:
        """Passes of minibatch descent on a loss.

        Args:
            schedule: for each pass, the minibatches, each a slice of the samples.
            loss: of one minibatch, a differentiable function of `parameters`.

        Returns:
            The mean loss of the last pass.

        Raises:
            NonFiniteError: if that is not finite.
        """
        mean = 0.0
        for blocks in schedule:
            losses = []
            for block in blocks:
                term = loss(block)
                (gradient,) = torch.autograd.grad(term, self.parameters)
                self._learner.descend("multiplier", gradient)
                losses.append(term.detach())
            mean = float(torch.stack(losses).mean())
            check_finite({"multiplier loss": mean})
        return mean
