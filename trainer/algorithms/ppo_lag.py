"""PPO-Lagrangian [Ray 2019]: one multiplier for all states."""

from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.algorithms.ppo import clipped_update
from trainer.dual import AdamMultiplier, Numbers, PidMultiplier
from trainer.learner import Batch, Learner
from trainer.rollout import Figures


def lagrangian_advantage(batch: Batch, multiplier: float) -> Tensor:
    """(A − λ A_c) / (1 + λ) [B]."""
    return (batch.reward_advantage - multiplier * batch.cost_advantage) / (1 + multiplier)


class PPOLag(Algorithm):
    """Once an epoch, before the policy: Adam's ascent on λ (J_c − d). Then PPO on (A − λ A_c) / (1 + λ)."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        self.dual = self.make_dual()

    def make_dual(self) -> AdamMultiplier | PidMultiplier:
        """What moves λ."""
        return AdamMultiplier(self.config.dual_init, self.config.dual_learning_rate)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        multiplier = self.dual.update(self.episode_cost(figures), self.config.cost_limit)
        advantage = lagrangian_advantage(batch, multiplier)
        return {"multiplier": multiplier} | clipped_update(self.learner, batch, advantage)

    def state(self) -> Numbers:
        """The dual's."""
        return self.dual.state()

    def load_state(self, state: Numbers) -> None:
        """Takes on the dual's."""
        self.dual.load_state(state)
