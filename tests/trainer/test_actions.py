import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from pointgoal.vector import PointGoalVectorEnv
from trainer.actions import action_range
from trainer.config import Config
from trainer.errors import ConfigError
from trainer.losses import saturation_loss

ROBOT = Box(-1, 1, (2,), np.float64)


def test_the_robots_thrust_is_drawn_in_units_of_its_saturation():
    actions = action_range(Config(), ROBOT)
    sent = actions.sent(torch.tensor([[0.5, 0.5], [-3, 3], [9, -9]]))
    np.testing.assert_allclose(sent, [[0.025, 0.593], [-0.05, 1], [0.05, -1]])
    np.testing.assert_allclose(actions.edge, [1, 1 - 0.093])


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_the_policy_draws_turns_the_robot_however_small(sign):
    """The servo's dead zone is as wide as it is said to be, and the range leads out of it."""
    actions = action_range(Config(), ROBOT)
    dead = float(actions.dead[1])
    small = actions.sent(torch.tensor([[0, sign * 0.02]]))[0]
    env = PointGoalVectorEnv(1, 3, num_threads=1)
    env.reset(seed=0)
    before = env.pose[:, 2].copy()
    for _ in range(100):
        env.step(np.array([[0, sign * (dead - 0.003)], [0, sign * (dead + 0.01)], small]))
    turned = sign * (env.pose[:, 2] - before)
    assert abs(turned[0]) < 0.01
    assert turned[1] > 0.05
    assert turned[2] > 0.05


def test_another_task_keeps_its_bounds():
    actions = action_range(Config(task="Other-v0"), Box(-3, 2, (1,), np.float64))
    assert actions.sent(torch.tensor([[-9], [9], [1.5]])).tolist() == [[-3], [2], [1.5]]


@pytest.mark.parametrize("useful", [(0.05,), (0.0, 1.0), (0.05, 1.5), (0.05, 0.09)])
def test_a_range_that_does_not_fit_is_told(useful):
    with pytest.raises(ConfigError, match="--action-range"):
        action_range(Config(action_range=useful), ROBOT)


def test_saturation_costs_only_beyond_the_edge():
    mean = torch.tensor([[0.5, -1.0], [2.0, -4.0]])
    assert saturation_loss(mean, torch.tensor([1.0, 2.0])).item() == pytest.approx((1**2 + 2**2) / 2)
