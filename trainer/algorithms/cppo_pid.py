"""CPPO-PID [Stooke 2020]: PPO-Lagrangian whose multiplier follows a PID controller."""

from trainer.algorithms.ppo_lag import PPOLag
from trainer.dual import PidMultiplier


class CPPOPid(PPOLag):
    """λ from the controller, then PPO on (A − λ A_c) / (1 + λ)."""

    def make_dual(self) -> PidMultiplier:
        """The controller."""
        c = self.config
        return PidMultiplier(c.dual_init, c.pid_kp, c.pid_ki, c.pid_kd, c.pid_smoothing, c.pid_delay)
