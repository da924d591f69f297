"""CPPO-PID [Stooke 2020]: PPO-Lagrangian whose multiplier follows a PID controller."""

from trainer.algorithms.base import Algorithm
from trainer.algorithms.ppo import clipped_update
from trainer.algorithms.ppo_lag import lagrangian_advantage
from trainer.dual import Numbers, PidMultiplier
from trainer.learner import Batch, Learner
from trainer.rollout import Figures


class CPPOPid(Algorithm):
    """λ from the controller, then PPO on (A − λ A_c) / (1 + λ)."""

    def __init__(self, learner: Learner) -> None:
        super().__init__(learner)
        c = self.config
        self.dual = PidMultiplier(c.dual_init, c.pid_kp, c.pid_ki, c.pid_kd, c.pid_smoothing, c.pid_delay)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        multiplier = self.dual.update(self.episode_cost(figures), self.config.cost_limit)
        advantage = lagrangian_advantage(batch, multiplier)
        return {"multiplier": multiplier} | clipped_update(self.learner, batch, advantage)

    def state(self) -> Numbers:
        """The controller's."""
        return self.dual.state()

    def load_state(self, state: Numbers) -> None:
        """Takes on the controller's."""
        self.dual.load_state(state)
