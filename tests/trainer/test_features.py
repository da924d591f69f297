import numpy as np
import pytest

from pointgoal.observation import layout
from trainer.config import Config
from trainer.features import GAIN, Features, nearness


@pytest.mark.parametrize(
    ("task", "bins"), [("PointGoal0-v0", 0), ("PointGoal1-v0", 16), ("PointGoal2-v0", 16)]
)
def test_nearness_follows_the_hazards_lidar(task, bins):
    size = layout(int(task[9])).size
    features = Features(size, nearness(Config(task=task, nearness=0.5)))
    assert features.size == size + bins
    observation = np.zeros((2, size))
    if bins:
        observation[1, layout(1).slice("hazards_lidar")] = 1 - np.linspace(0, 3, 16) / 3
        near = features(observation)[:, size:]
        np.testing.assert_allclose(near[1], GAIN * np.exp(-np.linspace(0, 3, 16) / 0.5), rtol=1e-5)
        assert near[0].max() < 0.02
    assert features(observation).shape == (2, features.size)


def test_nearness_can_be_left_out():
    assert nearness(Config(nearness=0.0)) is None
    assert nearness(Config(task="Other-v0")) is None
