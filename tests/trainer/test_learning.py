"""Each algorithm on a tiny task with a known optimum: within the limit, and better than doing nothing."""

import pytest

from trainer.config import Config
from trainer.train import train

LIMIT = 2.0
BEST = 10 + 2 * LIMIT - LIMIT**2 / 10
# OmniSafe's steps of the multiplier are meant for hundreds of epochs; this run has sixty.
SETTINGS = {
    "ppo": {},
    "ppo-lag": {"dual_learning_rate": 0.1, "dual_init": 0.5},
    "trpo-lag": {"dual_learning_rate": 0.1, "dual_init": 1.0},
    "cppo-pid": {"pid_ki": 0.03},
    "ipo": {},
    "cpo": {},
    "scpo": {"cost_limit": 20 * 0.25, "initial_log_std": -1.5},
    "lagnet": {"multiplier_init": 1.0, "multiplier_learning_rate": 3e-3},
    "lagnet-foresight": {
        "foresight": 0.0,
        "scale_init": 2.0,
        "scale_gain": 0.3,
        "scale_step": 0.1,
        "limit_share": 0.9,
    },
}
# Both step onto the limit itself, in a linear model of a cost that is convex: they end a little beyond.
BEYOND = {"cpo": 1.05, "scpo": 1.05}


def learn(algorithm, tmp_path, tiny_task):
    settings = {"cost_limit": LIMIT, "initial_log_std": -0.5, "entropy": 0.0} | SETTINGS[algorithm]
    config = Config(
        algorithm=algorithm, task="Tiny", action_repeat=1,
        out=tmp_path / "run", episode_steps=20, num_envs=20, epoch_steps=1000,
        total_steps=60_000, minibatch=250, passes=5, gae=0.95, tensorboard=False,
        learning_rate=3e-3, critic_learning_rate=3e-3,
        discount=0.9, threads=1, checkpoint_every=1000, fisher_every=1, **settings,
    )  # fmt: skip
    return train(config, lambda c: tiny_task(c.num_envs)).figures


def test_ppo_ignores_the_limit(tmp_path, tiny_task):
    figures = learn("ppo", tmp_path, tiny_task)
    assert figures["training_return"] > 19
    assert figures["training_cost"] > 9


@pytest.mark.parametrize("algorithm", [name for name in SETTINGS if name not in {"ppo", "scpo"}])
def test_constrained_algorithms_end_within_the_limit(algorithm, tmp_path, tiny_task):
    figures = learn(algorithm, tmp_path, tiny_task)
    assert figures["training_cost"] <= LIMIT * BEYOND.get(algorithm, 1.0)
    assert 0.5 * BEST < figures["training_return"] < BEST * 1.05


def test_scpo_limits_the_largest_cost_of_an_episode(tmp_path, tiny_task):
    figures = learn("scpo", tmp_path, tiny_task)
    assert figures["training_constrained"] <= 0.25 * BEYOND["scpo"]
    assert figures["training_return"] > 5
