"""TRPO-Lagrangian [Ray 2019]: the multiplier of PPO-Lagrangian, the step of TRPO [Schulman 2015]."""

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.algorithms.ppo_lag import lagrangian_advantage
from trainer.critics import check_finite, fit_critics
from trainer.dual import AdamMultiplier, Numbers
from trainer.learner import Batch, Learner
from trainer.rollout import Figures
from trainer.trust_region import Surrogates, conjugate_gradient, fisher, line_search, surrogates

LINE_SEARCH = 15


class TRPOLag(Algorithm):
    """Once an epoch: Adam's ascent on λ (J_c − d), then a TRPO step on (A − λ A_c) / (1 + λ)."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        self.dual = AdamMultiplier(self.config.dual_init, self.config.dual_learning_rate)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        multiplier = self.dual.update(self.episode_cost(figures), self.config.cost_limit)
        step = trpo_update(self.learner, batch, lagrangian_advantage(batch, multiplier))
        return {"multiplier": multiplier} | step | fit_critics(self.learner, batch)

    def state(self) -> Numbers:
        """The dual's."""
        return self.dual.state()

    def load_state(self, state: Numbers) -> None:
        """Takes on the dual's."""
        self.dual.load_state(state)


def trpo_update(learner: Learner, batch: Batch, advantage: Tensor) -> dict[str, float]:
    """The step √(2δ / xᵀHx) x with H x = g, shortened until the surrogate improves within the trust region.

    Args:
        learner: whose actor moves.
        batch: the epoch.
        advantage: A [B].

    Returns:
        Surrogate before the step, share of the step taken and divergence.

    Raises:
        NonFiniteError: if the surrogate or the step is not finite.
    """
    config = learner.config
    surrogate = surrogates(learner, batch, advantage).reward
    (g,) = torch.autograd.grad(surrogate, learner.actor)
    before = surrogate.item()
    product = fisher(learner, batch)
    x = conjugate_gradient(product, g, config.cg_iterations)
    curvature = x @ product(x)
    step = (2 * config.trust_kl / (curvature + 1e-8)).sqrt() * x
    check_finite({"policy surrogate": before, "trust-region step": float(step.sum())})

    def accept(found: Surrogates) -> bool:
        return bool(found.reward >= before) and bool(found.divergence <= config.trust_kl)

    share, kl = line_search(learner, batch, advantage, step, accept, LINE_SEARCH)
    return {"policy_loss": -before, "step_share": share, "kl": kl}
