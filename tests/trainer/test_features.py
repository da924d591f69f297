import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st

from pointgoal.lidar import encode
from pointgoal.observation import layout
from trainer.actions import action_range
from trainer.config import Config
from trainer.features import COASTING, GAIN, SHARPNESS, Features, surroundings
from trainer.networks import Shape, initial, mlp
from trainer.onnx_graph import Policy, exact, graph

HAZARDS, GOAL = layout(1).slice("hazards_lidar"), layout(1).slice("goal_lidar")
VELOCITY = layout(1).slice("velocimeter").start


def seen(observation, **settings):
    """The surroundings of one observation, in double precision."""
    return surroundings(Config(**settings)).double()(torch.from_numpy(observation)[None])[0].numpy()


def distance_to_segment(point, end):
    """From a point to the segment (0, 0) – end, by brute force."""
    on_way = np.linspace(0, 1, 20_001)[:, None] * np.asarray(end)
    return np.linalg.norm(on_way - point, axis=1).min()


@pytest.mark.parametrize(
    ("task", "numbers"), [("PointGoal0-v0", 0), ("PointGoal1-v0", 69), ("PointGoal2-v0", 69)]
)
def test_surroundings_belong_to_tasks_with_hazards(task, numbers):
    size = layout(int(task[9])).size
    features = Features(size, surroundings(Config(task=task)))
    assert features.size == size + numbers
    assert features(torch.zeros((2, size))).shape == (2, features.size)


def show(observation, lidar, distance, bearing):
    """Puts an object into a lidar as the simulation does; returns its bin."""
    (shown,) = encode(place(distance, bearing)[None, None])
    observation[lidar] = np.maximum(observation[lidar], shown)
    return int(shown.argmax())


def place(distance, bearing):
    return distance * np.array([np.cos(bearing), np.sin(bearing)])


angles = st.floats(-np.pi, np.pi)
distances = st.floats(0.05, 2.9)


@settings(max_examples=200)
@given(
    hazard=st.tuples(distances, angles),
    goal=st.tuples(distances, angles),
    velocity=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
)
def test_surroundings_of_one_hazard_and_the_goal_are_exact(hazard, goal, velocity):
    observation = np.zeros(60)
    b = show(observation, HAZARDS, *hazard)
    show(observation, GOAL, *goal)
    observation[VELOCITY : VELOCITY + 2] = velocity
    given_ = seen(observation, nearness=0.5)
    now, coasting, corridor, around, toward = np.split(given_, [16, 32, 48, 64])

    def near(distance):
        return pytest.approx(GAIN * np.exp(-distance / 0.5), rel=2e-3, abs=1e-4)

    coast, to_hazard, to_goal = COASTING * np.array(velocity), place(*hazard), place(*goal)
    assert now[b] == near(hazard[0])
    assert coasting[b] == near(distance_to_segment(to_hazard, coast))
    assert corridor[b] == near(distance_to_segment(to_hazard, to_goal))
    unit = to_goal / goal[0]
    sideways = np.array([-unit[1], unit[0]])
    expected = [*2 * unit, GAIN * np.exp(-goal[0]), GAIN * coast @ unit, GAIN * coast @ sideways]
    assert toward == pytest.approx(expected, abs=2e-3)
    apart = hazard[1] - goal[1] - np.arange(16) * np.pi / 8
    level = GAIN * np.exp(-hazard[0])  # 2 · 0.5 m
    # The empty bins hold hazards at 3 m; the neighbours' readings are places of their own, further away.
    assert (around >= level * np.exp(SHARPNESS * (np.cos(apart) - 1)) - 1e-3).all()
    best = np.argmax(np.cos(apart))
    assert around[best] == pytest.approx(level * np.exp(SHARPNESS * (np.cos(apart[best]) - 1)), abs=0.2)


def test_the_map_turns_with_the_goal():
    def around(turn):
        observation = np.zeros(60)
        for distance, bearing in ((0.4, 0.3), (0.9, 2.0), (1.5, 4.4)):
            show(observation, HAZARDS, distance, bearing + turn)
        show(observation, GOAL, 1.2, 1.1 + turn)
        return seen(observation)[48:64]

    for turn in np.linspace(0, 2 * np.pi, 16, endpoint=False):  # by whole bins
        assert around(turn) == pytest.approx(around(0.0), abs=1e-3)
    assert np.argmax(around(0.0)) == round((0.3 - 1.1) / (np.pi / 8)) % 16


def test_a_goal_out_of_sight_and_empty_bins_show_nothing():
    observation = np.zeros(60)
    b = show(observation, HAZARDS, 0.5, 0.1)
    unseen = seen(observation)
    assert (unseen[64:] == 0).all()
    assert (unseen[48:64] < 1e-3).all()
    show(observation, GOAL, 2.99, np.pi)
    corridor = seen(observation)[32:48]
    assert np.flatnonzero(corridor).tolist() == sorted([b, (b + 1) % 16, (b - 1) % 16])


def test_the_onnx_graph_sees_what_the_networks_see():
    rng = np.random.default_rng(0)
    observation = rng.normal(0, 1, (300, 60))
    observation[:, GOAL] = 0
    for k in range(1, 300):  # the first one sees nothing at all
        if k % 7:
            show(observation[k], GOAL, rng.uniform(0.01, 2.9), rng.uniform(-np.pi, np.pi))
        observation[k, HAZARDS] = rng.uniform(0, 1, 16) * (rng.uniform(size=16) < 0.5)
    observation = observation.astype(np.float32)
    features = Features(60, surroundings(Config()))
    features.normaliser.update(observation)
    shape = Shape(features.size, 2)
    theta = initial(shape, rng, 1.0)
    actions = action_range(Config(), Box(-1, 1, (2,)))
    precise = exact(features)
    data = graph(Policy(theta, shape, precise, actions), 60, "action")
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    (computed,) = session.run(["action"], {"observation": observation})
    drawn = mlp(theta.double(), precise(torch.from_numpy(observation).double()), shape)
    expected = actions.sent(drawn).numpy()
    assert np.abs(expected).min() < 0.01 < np.abs(expected).max()
    np.testing.assert_allclose(computed, expected, atol=1e-6)


def test_surroundings_can_be_left_out():
    assert surroundings(Config(nearness=0.0)) is None
    assert surroundings(Config(task="Other-v0")) is None
