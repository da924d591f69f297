import numpy as np
import pytest

from trainer.actions import ActionRange
from trainer.config import Config
from trainer.learner import Learner


def noise(progress, **settings):
    """Log standard deviations of a new policy at a share of the run."""
    unit = np.ones(2, np.float32)
    learner = Learner(
        Config(**settings), 5, ActionRange(unit, 0 * unit, -unit, unit), np.random.default_rng(0)
    )
    learner.start_epoch(progress)
    return learner.actor.detach().numpy()[-2:], learner


@pytest.mark.parametrize(
    ("progress", "bound"), [(0.0, 0.5), (0.5, 0.5), (0.7, -0.75), (0.9, -2.0), (0.99, -2.0)]
)
def test_the_largest_noise_falls_in_the_second_half(progress, bound):
    found, _ = noise(progress, initial_log_std=0.5, final_log_std=-2.0)
    np.testing.assert_allclose(found, bound, atol=1e-6)


def test_less_noise_than_the_bound_is_left_alone():
    found, _ = noise(0.99, initial_log_std=-3.0, final_log_std=-2.0)
    np.testing.assert_array_equal(found, -3.0)


def test_step_size_and_entropy_bonus_fall_to_zero():
    _, learner = noise(0.75, entropy=0.02, learning_rate=4e-4)
    assert learner.entropy == pytest.approx(0.005)
    assert learner.optimisers["actor"].param_groups[0]["lr"] == pytest.approx(1e-4)
