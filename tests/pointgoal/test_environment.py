"""The single and the vector environment: gymnasium's rules, exact states, seeds, resets, saved states."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from pointgoal.environment import PointGoalEnv
from pointgoal.lidar import encode
from pointgoal.observation import BIN_WIDTH, LIDAR_BINS, LIDAR_RANGE, layout
from pointgoal.seeds import spawn
from pointgoal.vector import PointGoalVectorEnv

IDS = [f"PointGoal{level}-v0" for level in (0, 1, 2)]


def exact_state(n: int | None = None, **changes: Any) -> dict[str, np.ndarray]:
    """A robot at rest in the origin, its goal 2 m ahead and everything else far away."""
    state = {
        "pose": np.zeros(3),
        "velocity": np.zeros(3),
        "goal": np.array([2.0, 0.0]),
        "hazards": np.full((8, 2), 20.0),
        "vase_qpos": np.array([[9.0, 9.0, 0.09996, 1.0, 0.0, 0.0, 0.0]]),
        "vase_qvel": np.zeros((1, 6)),
        **{name: np.asarray(value, float) for name, value in changes.items()},
    }
    return state if n is None else {name: np.repeat(array[None], n, axis=0) for name, array in state.items()}


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_accepts_the_environment(name: str) -> None:
    with warnings.catch_warnings():
        # Unbounded sensors are the task's; everything else that the checker warns of is a defect.
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(minimum|maximum) value is -?infinity.*")
        check_env(gymnasium.make(name, render_mode="rgb_array").unwrapped)


def run(program: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_the_installed_entry_point_registers() -> None:
    load = "from importlib.metadata import entry_points as e; e(group='gymnasium.envs')['pointgoal'].load()()"
    make = "import gymnasium; print(gymnasium.make('PointGoal1-v0').observation_space.shape)"
    assert run(f"{load}; {make}") == "(60,)"


def test_gymnasium_imports_the_package_by_its_name() -> None:
    # Gymnasium 1.0 gave its plug-in loader up for this form.
    make = "import gymnasium; print(gymnasium.make('pointgoal:PointGoal0-v0').observation_space.shape)"
    assert run(make) == "(28,)"


@pytest.mark.parametrize("name", IDS)
def test_vector_row_is_the_single_environment(name: str) -> None:
    n, row, seed = 5, 3, 11
    many, single = gymnasium.make_vec(name, num_envs=n), gymnasium.make(name)
    observations, _ = many.reset(seed=seed)
    observation, _ = single.reset(seed=spawn(seed, n)[row])
    np.testing.assert_array_equal(observations[row], observation)
    rng = np.random.default_rng(0)
    for _ in range(200):
        actions = rng.uniform(-1, 1, (n, 2))
        observations, rewards, _, _, infos = many.step(actions)
        observation, reward, _, _, info = single.step(actions[row])
        np.testing.assert_array_equal(observations[row], observation)
        assert (rewards[row], infos["cost"][row]) == (reward, info["cost"])


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_change_nothing(threads: int) -> None:
    runs = []
    for number in (1, threads):
        env = PointGoalVectorEnv(level=1, num_envs=7, num_threads=number)
        env.reset(seed=4)
        rng = np.random.default_rng(1)
        runs.append(np.array([env.step(rng.uniform(-1, 1, (7, 2)))[0] for _ in range(60)]))
        env.close()
    np.testing.assert_array_equal(*runs)


def test_an_episode_ends_after_1000_steps_and_starts_anew_in_the_same_step() -> None:
    env = PointGoalVectorEnv(level=1, num_envs=3)
    env.reset(seed=0, options={"elapsed_steps": [0, 998, 999]})
    _, _, _, truncated, info = env.step(np.zeros((3, 2)))
    assert truncated.tolist() == [False, False, True]
    assert info["_final_obs"].tolist() == [False, False, True]
    observation, _, _, truncated, info = env.step(np.zeros((3, 2)))
    assert truncated.tolist() == [False, True, False]
    assert (info["final_obs"][1] != observation[1]).any()
    assert env.elapsed_steps.tolist() == [2, 0, 1]


def test_an_episode_that_ends_does_not_touch_its_neighbours() -> None:
    n, ends = 4, 2
    plain, staggered = (PointGoalVectorEnv(level=1, num_envs=n, num_threads=1) for _ in range(2))
    plain.reset(seed=3)
    staggered.reset(seed=3, options={"elapsed_steps": np.where(np.arange(n) == ends, 995, 0)})
    others = np.arange(n) != ends
    rng = np.random.default_rng(0)
    for step in range(10):
        action = rng.uniform(-1, 1, (n, 2))
        (ours, *_), (theirs, _, _, truncated, info) = plain.step(action), staggered.step(action)
        np.testing.assert_array_equal(ours[others], theirs[others])
        assert truncated.tolist() == [False, False, step == 4, False]
        if step == 4:
            np.testing.assert_array_equal(info["final_obs"], ours)


@pytest.mark.parametrize("kind", ["single", "vector"])
def test_a_goal_that_finds_no_place_ends_the_episode(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    met = exact_state(goal=[0.2, 0.0])
    monkeypatch.setattr("pointgoal.simulation.sample_goal", lambda *_: None)
    if kind == "single":
        env = PointGoalEnv(level=1)
        env.reset(seed=0, options={"state": met})
        _, reward, terminated, truncated, _ = env.step(np.zeros(2))
        assert (reward, terminated, truncated) == (pytest.approx(1.0), True, False)
        with pytest.raises(RuntimeError, match="after the episode ended"):
            env.step(np.zeros(2))
        return
    many = PointGoalVectorEnv(level=1, num_envs=2)
    far = exact_state()
    many.reset(seed=0, options={"state": {name: np.stack([met[name], far[name]]) for name in met}})
    observation, rewards, terminations, _, info = many.step(np.zeros((2, 2)))
    assert terminations.tolist() == info["_final_obs"].tolist() == [True, False]
    assert rewards[0] == pytest.approx(1.0)
    assert (info["final_obs"][0] != observation[0]).any()
    assert many.elapsed_steps.tolist() == [0, 1]


def test_reset_mask_leaves_the_others_generators_alone() -> None:
    mask = np.array([True, False])
    plain, seeded = PointGoalVectorEnv(level=1, num_envs=2), PointGoalVectorEnv(level=1, num_envs=2)
    for env in (plain, seeded):
        env.reset(seed=5)
    seeded.reset(seed=99, options={"reset_mask": mask})
    drawn = [env.reset()[0] for env in (plain, seeded)]
    np.testing.assert_array_equal(drawn[0][1], drawn[1][1])
    assert (drawn[0][0] != drawn[1][0]).any()


@pytest.mark.parametrize("elapsed", [[0, -1], [0, 1000], [0]])
def test_a_start_outside_the_episode_is_refused(elapsed: list[int]) -> None:
    env = PointGoalVectorEnv(level=1, num_envs=2)
    with pytest.raises(ValueError, match="elapsed_steps"):
        env.reset(seed=0, options={"elapsed_steps": elapsed})


def test_reset_mask_leaves_the_others_alone() -> None:
    env = PointGoalVectorEnv(level=1, num_envs=4, num_threads=2)
    env.reset(seed=0)
    for _ in range(5):
        before, *_ = env.step(np.ones((4, 2)))
    mask = np.array([False, True, False, True])
    after, _ = env.reset(options={"state": exact_state(4, pose=[0.5, 0.0, 0.0]), "reset_mask": mask})
    np.testing.assert_array_equal(after[~mask, 3:], before[~mask, 3:])
    np.testing.assert_array_equal(env.pose[mask], [[0.5, 0.0, 0.0]] * 2)
    assert env.elapsed_steps.tolist() == [5, 0, 5, 0]


@pytest.mark.parametrize("level", [1, 2])
def test_a_loaded_state_goes_on_bit_for_bit(level: int) -> None:
    n = 6
    env = PointGoalVectorEnv(level=level, num_envs=n)
    env.reset(seed=2, options={"elapsed_steps": np.arange(n) * 180})
    actions = np.random.default_rng(3).uniform(-1, 1, (200, n, 2))
    for action in actions[:80]:
        env.step(action)
    state = {name: array.copy() for name, array in env.state_dict().items()}
    other = PointGoalVectorEnv(level=level, num_envs=n)
    other.load_state_dict(state)
    for action in actions[80:]:
        for ours, theirs in zip(env.step(action)[:4], other.step(action)[:4], strict=True):
            np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="begun"):
        PointGoalVectorEnv(level=level, num_envs=n + 1).load_state_dict(state)


@pytest.mark.parametrize("level", [1, 2])
def test_saving_a_state_changes_nothing(level: int) -> None:
    """Vases fall asleep after some steps: one that is saved on the way must stay so."""
    saved, plain = (PointGoalVectorEnv(level=level, num_envs=3, num_threads=1) for _ in range(2))
    for env in (saved, plain):
        env.reset(seed=4)
    actions = np.random.default_rng(5).uniform(-1, 1, (150, 3, 2))
    for step, action in enumerate(actions):
        if step % 7 == 0:
            saved.state_dict()
        for ours, theirs in zip(saved.step(action)[:4], plain.step(action)[:4], strict=True):
            np.testing.assert_array_equal(ours, theirs)
        for ours, theirs in zip(saved.simulations, plain.simulations, strict=True):
            np.testing.assert_array_equal(ours.vases, theirs.vases)


def copied(env: Any, way: str) -> Any:
    return pickle.loads(pickle.dumps(env)) if way == "pickle" else getattr(copy, way)(env)


@pytest.mark.parametrize("way", ["copy", "deepcopy", "pickle"])
def test_a_copy_goes_on_alike_and_by_itself(way: str) -> None:
    rng = np.random.default_rng(6)
    env = gymnasium.make("PointGoal1-v0", max_episode_steps=90)
    env.reset(seed=7)
    many = PointGoalVectorEnv(level=1, num_envs=5, num_threads=2, max_episode_steps=90)
    many.reset(seed=7, options={"elapsed_steps": np.arange(5) * 15})
    for _ in range(50):
        env.step(rng.uniform(-1, 1, 2))
        many.step(rng.uniform(-1, 1, (5, 2)))
    other, others = copied(env.unwrapped, way), copied(many, way)
    before = other.pose, others.pose
    actions = rng.uniform(-1, 1, (60, 5, 2))
    ours = [(env.unwrapped.step(action[0])[:4], many.step(action)[:4]) for action in actions]
    assert (other.pose == before[0]).all()
    assert (others.pose == before[1]).all()
    for action, (alone, side_by_side) in zip(actions, ours, strict=True):
        for mine, theirs in zip(alone, other.step(action[0])[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        for mine, theirs in zip(side_by_side, others.step(action)[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
    # And the next episode: the generators went along.
    np.testing.assert_array_equal(env.unwrapped.reset()[0], other.reset()[0])
    for each in (many, others):
        each.close()


def test_before_its_first_reset_it_can_be_copied_as_well() -> None:
    for env in (PointGoalEnv(level=0), PointGoalVectorEnv(level=0, num_envs=2)):
        other = copied(env, "pickle")
        np.testing.assert_array_equal(env.reset(seed=1)[0], other.reset(seed=1)[0])


FORKED = """
import os, sys
import numpy as np
from pointgoal.vector import PointGoalVectorEnv
env = PointGoalVectorEnv(level=1, num_envs=4, num_threads=2)
env.reset(seed=0)
env.step(np.ones((4, 2)))
read, write = os.pipe()
child = os.fork()
observation = env.step(np.ones((4, 2)))[0]
if child == 0:
    os.write(write, observation.tobytes())
    env.close()
    os._exit(0)
os.waitpid(child, 0)
assert os.read(read, 8 * observation.size) == observation.tobytes()
env.close()
print("alike")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_forked_after_a_step_it_goes_on() -> None:
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKED]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.stdout == "alike\n", result.stderr


def test_episodes_are_as_long_as_asked_for() -> None:
    assert gymnasium.make("PointGoal1-v0").spec.max_episode_steps == 1000
    assert gymnasium.make_vec("PointGoal1-v0", num_envs=2).spec.max_episode_steps == 1000
    for steps in (5, 1003):
        env = gymnasium.make("PointGoal0-v0", max_episode_steps=steps)
        env.reset(seed=0)
        ended = [env.step(np.zeros(2))[3] for _ in range(steps)]
        assert ended == [False] * (steps - 1) + [True]
        many = gymnasium.make_vec("PointGoal0-v0", num_envs=2, max_episode_steps=steps)
        many.reset(seed=0)
        ended = [many.step(np.zeros((2, 2)))[3].tolist() for _ in range(steps)]
        assert ended == [[False] * 2] * (steps - 1) + [[True] * 2]
    for make in (PointGoalEnv, PointGoalVectorEnv):
        with pytest.raises(ValueError, match="max_episode_steps must be at least 1, got 0"):
            make(max_episode_steps=0)


@pytest.mark.parametrize("turning", [1e4, -1e4, 0.0])
def test_the_fastest_states_are_driven_from_and_not_put_back(turning: float) -> None:
    env = PointGoalEnv(level=1)
    vase = np.full((1, 6), 1e4)
    state = exact_state(pose=[3e3, 4e3, 1e4], velocity=[1e4, -1e4, turning], vase_qvel=vase)
    env.reset(options={"state": state})
    before = env.pose
    for _ in range(3):
        env.step(np.zeros(2))
        assert 1.0 < np.hypot(*(env.pose - before)[:2]) < 500.0
        before = env.pose


def test_costs() -> None:
    deep = exact_state(hazards=np.vstack([[[0.05, 0.0], [0.0, -0.1]], np.full((6, 2), 9.0)]))
    for kind, expected in (("depth", 0.15 + 0.1), ("indicator", 1.0)):
        env = gymnasium.make("PointGoal1-v0", cost=kind)
        _, info = env.reset(options={"state": deep})
        assert info["cost"] == 0.0
        assert env.step(np.zeros(2))[4]["cost"] == pytest.approx(expected, abs=1e-12)
    with pytest.raises(ValueError, match="cost must be"):
        gymnasium.make("PointGoal1-v0", cost="deep")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": {"pose": np.zeros(3)}}, "lacks 'velocity'"),
        ({"state": exact_state() | {"goal": np.zeros(3)}}, r"'goal' has shape \(1, 3\)"),
        ({"state": exact_state() | {"colour": np.zeros(3)}}, "unknown fields"),
        ({"state": exact_state() | {"pose": np.array([0, np.nan, 0])}}, "'pose' must be finite"),
        ({"state": exact_state(velocity=[1e11, 0.0, 0.0])}, "'velocity' must be finite and within"),
        ({"state": exact_state(vase_qvel=np.full((1, 6), -2e4))}, "'vase_qvel' must be finite and within"),
        ({"start": 1}, "no options"),
    ],
)
def test_a_bad_reset_names_the_field(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gymnasium.make("PointGoal1-v0").unwrapped.reset(options=options)


def test_bad_actions_are_refused() -> None:
    env = PointGoalVectorEnv(level=1, num_envs=2)
    with pytest.raises(RuntimeError, match="before reset"):
        env.step(np.zeros((2, 2)))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="shape"):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full((2, 2), np.nan))


def plain_lidar(points: np.ndarray) -> np.ndarray:
    """Readings (16,) for body-frame points (k, 2), one point at a time, from the task's definition."""
    readings = np.zeros(LIDAR_BINS)
    for x, y in points:
        angle = np.arctan2(y, x) % (2 * np.pi)
        bin_, alias = int(angle / BIN_WIDTH) % LIDAR_BINS, angle / BIN_WIDTH % 1
        reading = max(0.0, LIDAR_RANGE - np.hypot(x, y)) / LIDAR_RANGE
        for index, value in ((bin_, reading), (bin_ + 1, alias * reading), (bin_ - 1, (1 - alias) * reading)):
            readings[index % LIDAR_BINS] = max(readings[index % LIDAR_BINS], value)
    return readings


lidar_environment = PointGoalEnv(level=1)
coordinate = st.floats(-3, 3, allow_nan=False)


@given(
    pose=st.tuples(coordinate, coordinate, st.floats(-40, 40)),
    hazards=st.lists(st.tuples(coordinate, coordinate), min_size=8, max_size=8),
)
@settings(max_examples=100, deadline=None)
def test_lidar_follows_its_definition(pose: tuple[float, ...], hazards: list[tuple[float, float]]) -> None:
    observation, _ = lidar_environment.reset(options={"state": exact_state(pose=pose, hazards=hazards)})
    readings = observation[layout(1).slice("hazards_lidar")]
    centres = lidar_environment.hazards_in_body_frame()
    np.testing.assert_allclose(readings, plain_lidar(centres), atol=1e-9)
    np.testing.assert_allclose(encode(centres[None])[0], readings, atol=1e-9)


def test_a_bearing_just_below_straight_ahead_reads_in_the_first_bin() -> None:
    env = gymnasium.make("PointGoal1-v0").unwrapped
    hazards = np.vstack([[[1.0, -1e-17]], np.full((7, 2), 20.0)])
    observation, _ = env.reset(options={"state": exact_state(hazards=hazards)})
    assert observation[layout(1).slice("hazards_lidar")][0] == pytest.approx(2 / 3)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_pictures_show_the_cost(level: int) -> None:
    env = PointGoalVectorEnv(level=level, num_envs=2, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert pictures is not None
    assert [picture.shape for picture in pictures] == [(480, 480, 3)] * 2
    if level == 1:
        near = exact_state(hazards=np.vstack([[[0.05, 0.0]], np.full((7, 2), 20.0)]))
        single = gymnasium.make("PointGoal1-v0", render_mode="rgb_array").unwrapped
        single.reset(options={"state": near})
        before = single.render()
        single.step(np.zeros(2))
        after = single.render()
        red = [(p[0] == [214, 40, 40]).all() for p in (before, after)]
        assert red == [False, True]
