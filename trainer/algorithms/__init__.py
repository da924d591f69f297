"""The algorithms by name. Each is a class with `update`, `state` and `load_state`."""

from collections.abc import Callable
from typing import Protocol

from trainer.algorithms.lagnet import Lagnet
from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.algorithms.ppo import PPO
from trainer.learner import Batch, Learner
from trainer.rollout import Figures


class Algorithm(Protocol):
    """What the training loop asks of an algorithm."""

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch; returns the figures to log."""

    def multiplier_network(self) -> MultiplierNetwork | None:
        """λ_ξ, if the algorithm learns one."""

    def state(self) -> dict[str, float | list[float]]:
        """What a checkpoint must keep beside the learner's tensors."""

    def load_state(self, state: dict[str, float | list[float]]) -> None:
        """Takes on what state returned."""


def build(name: str, learner: Learner) -> Algorithm:
    """The algorithm of that name, on that learner."""
    algorithms: dict[str, Callable[[Learner], Algorithm]] = {"ppo": PPO, "lagnet": Lagnet}
    return algorithms[name](learner)
