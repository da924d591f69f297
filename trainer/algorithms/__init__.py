"""The algorithms by name."""

from typing import Any

from gymnasium.vector import VectorEnv

from trainer.algorithms.base import Algorithm
from trainer.algorithms.cpo import CPO
from trainer.algorithms.cppo_pid import CPPOPid
from trainer.algorithms.ipo import IPO
from trainer.algorithms.lagnet import Lagnet
from trainer.algorithms.lagnet_foresight import LagnetForesight
from trainer.algorithms.ppo import PPO
from trainer.algorithms.ppo_lag import PPOLag
from trainer.algorithms.scpo import SCPO, MaximumCost
from trainer.algorithms.trpo_lag import TRPOLag
from trainer.repeat import Repeat

ALGORITHMS: dict[str, type[Algorithm]] = {
    "ppo": PPO,
    "ppo-lag": PPOLag,
    "trpo-lag": TRPOLag,
    "cppo-pid": CPPOPid,
    "ipo": IPO,
    "cpo": CPO,
    "scpo": SCPO,
    "lagnet": Lagnet,
    "lagnet-foresight": LagnetForesight,
}


def prepare_environments(
    algorithm: str, env: VectorEnv[Any, Any, Any], action_repeat: int
) -> VectorEnv[Any, Any, Any]:
    """The vector environment as the algorithm wants to see it."""
    inner = MaximumCost(env) if algorithm == "scpo" else env
    return Repeat(inner, action_repeat) if action_repeat > 1 else inner
