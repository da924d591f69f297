import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointgoal.observation import layout
from trainer.config import Config
from trainer.features import COASTING, GAIN, Features, nearness

LIDAR = layout(1).slice("hazards_lidar")
VELOCITY = layout(1).slice("velocimeter").start


def distance_to_segment(point, end):
    """From a point to the segment (0, 0) – end, by brute force."""
    on_way = np.linspace(0, 1, 20_001)[:, None] * np.asarray(end)
    return np.linalg.norm(on_way - point, axis=1).min()


@pytest.mark.parametrize(
    ("task", "numbers"), [("PointGoal0-v0", 0), ("PointGoal1-v0", 32), ("PointGoal2-v0", 32)]
)
def test_nearness_belongs_to_tasks_with_hazards(task, numbers):
    size = layout(int(task[9])).size
    features = Features(size, nearness(Config(task=task)))
    assert features.size == size + numbers
    assert features(np.zeros((2, size))).shape == (2, features.size)


@settings(max_examples=200)
@given(
    distance=st.floats(0.05, 2.9),
    bearing=st.floats(-np.pi, np.pi),
    velocity=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
)
def test_nearness_of_a_hazard_alone_is_exact(distance, bearing, velocity):
    place = np.remainder(bearing, 2 * np.pi) * 8 / np.pi
    b, share, reading = int(place) % 16, place - int(place), 1 - distance / 3
    observation = np.zeros(60)
    for k, value in ((b, reading), (b + 1, share * reading), (b - 1, (1 - share) * reading)):
        observation[LIDAR.start + k % 16] = value
    observation[VELOCITY : VELOCITY + 2] = velocity
    near = nearness(Config(nearness=0.5))(observation)
    assert near[b] == pytest.approx(GAIN * np.exp(-distance / 0.5), rel=1e-4)
    hazard = distance * np.array([np.cos(bearing), np.sin(bearing)])
    passing = distance_to_segment(hazard, COASTING * np.array(velocity))
    assert near[16 + b] == pytest.approx(GAIN * np.exp(-passing / 0.5), rel=2e-3)


def test_nearness_can_be_left_out():
    assert nearness(Config(nearness=0.0)) is None
    assert nearness(Config(task="Other-v0")) is None
