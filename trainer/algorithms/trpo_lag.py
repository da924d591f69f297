"""TRPO-Lagrangian [Ray 2019]: the multiplier of PPO-Lagrangian, the step of TRPO [Schulman 2015]."""

from trainer.algorithms.base import Algorithm
from trainer.algorithms.ppo_lag import lagrangian_advantage
from trainer.dual import AdamMultiplier, Numbers
from trainer.learner import Batch, Learner
from trainer.rollout import Figures
from trainer.trust_region import expected, trust_region_update


class TRPOLag(Algorithm):
    """Once an epoch: Adam's ascent on λ (J_c − d), then a TRPO step on (A − λ A_c) / (1 + λ)."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        self.dual = AdamMultiplier(self.config.dual_init, self.config.dual_learning_rate)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        multiplier = self.dual.update(self.episode_cost(figures), self.config.cost_limit)
        objective = expected(lagrangian_advantage(batch, multiplier))
        return {"multiplier": multiplier} | trust_region_update(self.learner, batch, objective)

    def state(self) -> Numbers:
        """The dual's."""
        return self.dual.state()

    def load_state(self, state: Numbers) -> None:
        """Takes on the dual's."""
        self.dual.load_state(state)
