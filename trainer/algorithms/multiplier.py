"""The multiplier network λ_ξ(s)."""

import math

from torch import Tensor
from torch.nn.functional import softplus

from trainer.learner import Learner
from trainer.networks import fast_mlp, initial


class MultiplierNetwork:
    """λ_ξ(s) = scale · softplus(f_ξ(s)) ≥ 0, registered with the learner under the name "multiplier".

    f_ξ's last layer starts near zero, with a bias that puts the softplus at `start` in every state.

    Attributes:
        parameters: ξ [P].
        scale: the factor; 1 unless an algorithm moves it.
    """

    def __init__(self, learner: Learner, start: float, learning_rate: float) -> None:
        self._shape = learner.critic_shape
        xi = initial(self._shape, learner.rng, 0.01)
        xi[-1] = start + math.log(-math.expm1(-start)) if start > 0 else -20.0
        self.parameters = learner.add("multiplier", xi, learning_rate)
        self.scale = 1.0

    def raw(self, observation: Tensor) -> Tensor:
        """softplus(f_ξ(s)) [B] for the networks' inputs [B, m]."""
        return softplus(fast_mlp(self.parameters, observation, self._shape)[:, 0])

    def __call__(self, observation: Tensor) -> Tensor:
        """λ_ξ(s) [B] for the networks' inputs [B, m]."""
        return self.scale * self.raw(observation)
