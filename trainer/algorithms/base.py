"""What the training loop asks of an algorithm, and the state most of them do not have."""

from trainer.algorithms.multiplier import MultiplierNetwork
from trainer.dual import Numbers
from trainer.learner import Batch, Learner
from trainer.rollout import Figures, Trajectory


class Algorithm:
    """A learning rule. Subclasses give `update`; those that keep numbers between epochs, the state too."""

    def __init__(self, learner: Learner) -> None:
        self.learner = learner
        self.config = learner.config

    def batch(self, trajectory: Trajectory) -> Batch:
        """The epoch's samples."""
        discount = self.config.per_decision(self.config.cost_discount)
        return self.learner.batch(trajectory, discount, cost_outlives_episode=True)

    def update(self, batch: Batch, figures: Figures) -> dict[str, float]:
        """One update on one epoch.

        Args:
            batch: the epoch.
            figures: of the episodes up to now.

        Returns:
            Figures to log; "multiplier" is always among them.

        Raises:
            NonFiniteError: if a loss is not finite; names it.
        """
        raise NotImplementedError

    def multiplier_network(self) -> MultiplierNetwork | None:
        """λ_ξ, if the algorithm learns one."""
        return None

    def state(self) -> Numbers:
        """What a checkpoint must keep beside the learner's tensors."""
        return {}

    def load_state(self, state: Numbers) -> None:
        """Takes on what `state` returned."""

    def episode_cost(self, figures: Figures) -> float:
        """J_c: of the last 100 episodes; before one has ended, from the mean cost of the epoch's steps."""
        if figures.episode_cost is None:
            return figures.step_cost * self.config.episode_steps
        return figures.episode_cost
