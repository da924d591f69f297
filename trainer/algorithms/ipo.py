"""IPO [Liu 2020]: PPO with a barrier in place of a multiplier."""

import torch
from torch import Tensor

from trainer.algorithms.base import Algorithm
from trainer.algorithms.ppo import clipped_update, proximal_update
from trainer.algorithms.ppo_lag import lagrangian_advantage
from trainer.learner import Batch
from trainer.losses import clipped_surrogate
from trainer.rollout import Figures


def log_barrier(excess: Tensor, sharpness: float) -> Tensor:
    """−log(−z) / t for z ≤ −1/t², and its tangent beyond.

    The paper's barrier asks for feasible iterates, which a new policy is not; the tangent, of slope t, leads
    back from outside [Kervadec 2019, "Constrained deep networks: Lagrangian optimization via log-barrier
    extensions"].

    Args:
        excess: z = Ĵ_c − d, scalar.
        sharpness: t.

    Returns:
        Scalar to minimise.
    """
    edge = 1.0 / sharpness**2
    inside = -torch.log(-excess.clamp(max=-edge)) / sharpness
    beyond = sharpness * (excess + edge).clamp(min=0)
    return inside + beyond


def omnisafe_penalty(episode_cost: float, limit: float, kappa: float) -> float:
    """OmniSafe's p = κ / (d − J_c), or 1 where that is negative or above 1."""
    penalty = kappa / (limit - episode_cost + 1e-8)
    return penalty if 0 <= penalty <= 1 else 1.0


class IPO(Algorithm):
    """Maximises PPO's surrogate + log(d − Ĵ_c) / t, with Ĵ_c = J_c + H · E[(r − 1) A_c].

    Ĵ_c is the episode cost to first order in the policy's change: H decisions, each of which changes by the
    mean of (r − 1) A_c. With ipo_form "omnisafe", PPO on (A − p A_c) / (1 + p) instead.
    """

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch, see Algorithm.update."""
        config = self.config
        cost = self.episode_cost(figures)
        if config.ipo_form == "omnisafe":
            penalty = omnisafe_penalty(cost, config.cost_limit, config.ipo_kappa)
            advantage = lagrangian_advantage(batch, penalty)
            return {"multiplier": penalty} | clipped_update(self.learner, batch, advantage)

        def loss(ratio: Tensor, block: slice) -> Tensor:
            change = ((ratio - 1) * batch.cost_advantage[block]).mean()
            excess = cost + config.episode_decisions * change - config.cost_limit
            reward = clipped_surrogate(ratio, batch.reward_advantage[block], config.clip)
            return reward + log_barrier(excess, config.ipo_sharpness)

        slope = min(config.ipo_sharpness, 1 / (config.ipo_sharpness * max(1e-8, config.cost_limit - cost)))
        return {"multiplier": slope} | proximal_update(self.learner, batch, loss)
