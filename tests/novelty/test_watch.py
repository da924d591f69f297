"""What sensors should show: the exact model says so, and a sensor that fails shows something else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from decision import MEMORY, MOST_LATE
from novelty import GROUPS, STEERED_BY, Normal, Watch, calibrate, learn, nothing
from novelty.consistency import NEVER, SURPRISE, count_of_numbers, numbers_of
from novelty.watch import FLOORS
from pointgoal.observation import layout
from system.point_robot import Robot

N, STEPS = 24, 160
STEERING = [name for name, steered in zip(GROUPS, STEERED_BY, strict=True) if steered]


@pytest.fixture(scope="module")
def drives(drive, hand) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions [T, N, ...] of robots that seek their goals and never look out."""
    rng, seen, sent = np.random.default_rng(0), [], []
    for now in drive(STEPS, n=N):
        seen.append(now.observation.copy())
        now.action = hand.seeker(now.observation, now.hazards, rng) * [0.05, 1.0]
        sent.append(np.clip(now.action, -1.0, 1.0))
    return np.array(seen), np.array(sent)


def look(watch: Watch, seen: np.ndarray, sent: np.ndarray, delay: int = 0) -> list:
    """What a watch finds, step by step; ``sent`` takes effect so many steps late."""
    memory, found = np.zeros(seen.shape[1], MEMORY), []
    for observation, action in zip(seen, sent, strict=False):
        found.append(watch.look(np.ascontiguousarray(observation), memory))
        watch.remember(observation, found[-1], memory)
        sent_now = memory["history"]["sent"]
        sent_now[:, 1:] = sent_now[:, :-1].copy()
        sent_now[:, 0] = action
    return found


@pytest.fixture(scope="module")
def normal(drives) -> Normal:
    seen, sent = drives
    learnt = learn(seen[::4].reshape(-1, seen.shape[-1]))
    unlimited = Normal(learnt.mean, learnt.precision, np.zeros(3), np.full(FLOORS.shape, np.inf))
    largest = np.max([found.off.max(axis=0) for found in look(Watch(unlimited, Robot()), seen, sent)], axis=0)
    return calibrate(learnt, largest, np.array([0.0, 0.05, 0.0]))


def failing(seen: np.ndarray, sensor: str, fault: str, begins: int) -> np.ndarray:
    shown, where = seen.copy(), layout(1).slice(sensor)
    late = shown[begins:, :, where]
    if fault == "zero":
        late[:] = 0.0
    elif fault == "frozen":
        late[:] = seen[begins, :, where]
    elif fault == "negated":
        late *= -1.0
    elif fault == "late":
        late[:] = seen[begins - 3 : -3, :, where]
    else:
        late += np.random.default_rng(1).normal(size=late.shape) * max(late.std(), 0.05)
    return shown


def test_nothing_is_novel_where_nothing_fails(drives, normal) -> None:
    for found in look(Watch(normal, Robot()), *drives):
        assert not found.any
        assert (found.novelty <= 1.0).all()
        assert not found.doubted.any()
        assert (found.suspect == "").all()


def test_physics_is_exact_where_nothing_is_touched(drives, normal) -> None:
    off = np.array([found.off[:, 0] for found in look(Watch(normal, Robot()), *drives)])
    assert (np.quantile(off, 0.9, axis=(0, 1)) < [0.01, 1e-3, 0.05, 1e-4, 1e-4, 1e-4, 1e-4]).all()
    # It is not that nothing is compared.
    assert (np.median(off[1:], axis=(0, 1))[[0, 1, 3, 4]] > 0.0).all()


@pytest.mark.parametrize("fault", ["zero", "frozen", "negated", "noise", "late"])
@pytest.mark.parametrize("sensor", GROUPS)
def test_a_sensor_that_fails_is_noticed(drives, normal, sensor, fault) -> None:
    seen, sent = drives
    begins = 60
    found = look(Watch(normal, Robot()), failing(seen, sensor, fault, begins), sent)
    assert not any(one.any for one in found[:begins])
    novel = np.array([one.novelty > 1.0 for one in found[begins : begins + 50]])
    share = 0.9 if sensor in ("velocimeter", "hazards_lidar") else 0.5
    if (sensor, fault) == ("accelerometer", "late"):
        share = 0.05  # what it shows hardly changes in three steps, and nobody steers by it
    assert novel.any(axis=0).mean() >= share
    doubted = np.array([one.doubted for one in found[begins : begins + 50]])
    if sensor in STEERING:
        assert doubted.any(axis=0).mean() >= share
        # From then on it is not trusted.
        first = doubted.argmax(axis=0)
        for robot in np.flatnonzero(doubted.any(axis=0)):
            assert doubted[first[robot] :, robot].all()
    if share >= 0.5:
        assert sensor in {name for one in found[begins:] for name in one.suspect.tolist()}


def test_a_late_robot_is_told_what_is_under_way(drive, hand, normal) -> None:
    rng, late, seen, sent = np.random.default_rng(0), 2, [], []
    queue = [np.zeros((N, 2))] * late
    for now in drive(80, n=N):
        seen.append(now.observation.copy())
        sent.append(hand.seeker(now.observation, now.hazards, rng) * [0.05, 1.0])
        queue.append(sent[-1])
        now.action = queue.pop(0)
    seen, sent = np.array(seen), np.array(sent)
    told = np.array([f.off[:, 0, 1] for f in look(Watch(normal, Robot(), late), seen, sent)])
    not_told = np.array([f.off[:, 0, 1] for f in look(Watch(normal, Robot(), 0), seen, sent)])
    assert np.quantile(told, 0.95) < 2e-3
    assert np.quantile(not_told, 0.95) > 0.02


def test_an_empty_scan_of_the_hazards_is_noticed_at_once(drives, normal) -> None:
    blank = failing(drives[0][:1], "hazards_lidar", "zero", 0)
    [found] = look(Watch(normal, Robot()), blank, drives[1][:1])
    assert found.doubted.all()
    assert (found.suspect == "hazards_lidar").all()
    assert (found.off[:, 0, GROUPS.index("hazards_lidar")] == NEVER).all()


def test_it_is_trusted_again_only_with_a_new_memory(drives, normal) -> None:
    """Not because it is well again: a frozen sensor of a robot that stands looks well."""
    seen, _ = drives
    still, watch, memory = np.ascontiguousarray(seen[0, :1]), Watch(normal, Robot()), np.zeros(1, MEMORY)
    still[:, layout(1).slice("velocimeter")] = still[:, layout(1).slice("gyro")] = 0.0
    still[:, layout(1).slice("accelerometer")] = (0.0, 0.0, 9.81)
    wrong = still.copy()
    wrong[:, layout(1).slice("velocimeter")] = (1.0, 0.0, 0.0)

    def step(observation: np.ndarray) -> bool:
        found = watch.look(observation, memory)
        watch.remember(observation, found, memory)
        return bool(found.doubted[0])

    assert not step(still)
    assert step(wrong)
    assert all(step(still) for _ in range(2000))
    memory = np.zeros(1, MEMORY)
    assert not step(still)


def test_what_is_long_past_is_not_compared(drives, normal) -> None:
    seen, _ = drives
    watch, memory = Watch(normal, Robot()), np.zeros(N, MEMORY)
    watch.remember(seen[0], watch.look(seen[0], memory), memory)
    memory["history"]["age"] = MOST_LATE + 2
    assert (watch.look(seen[60], memory).off[:, 0] == 0.0).all()
    memory["history"]["age"] = 1
    assert (watch.look(seen[60], memory).off[:, 0] > 0.0).any()


def test_a_batch_is_its_rows(drives, normal) -> None:
    seen, _ = drives
    watch, memory = Watch(normal, Robot()), np.zeros(N, MEMORY)
    memory["history"]["sensed"], memory["history"]["age"] = seen[30], 1
    whole = watch.look(seen[33], memory)
    for k in range(N):
        alone = watch.look(seen[33, k : k + 1], memory[k : k + 1])
        assert alone.off.tobytes() == whole.off[k : k + 1].tobytes()
        assert (alone.novelty[0], alone.suspect[0], alone.doubted[0]) == (
            whole.novelty[k],
            whole.suspect[k],
            whole.doubted[k],
        )


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32))
def test_surprise_is_the_distance_less_that_of_the_others(drives, normal, seed) -> None:
    """The conditional distance of a sensor: the whole one less the marginal one of all other numbers."""
    rng = np.random.default_rng(seed)
    observation = drives[0][rng.integers(STEPS), rng.integers(N)][None] + rng.normal(0.0, 0.1, (1, 60))
    numbers = np.empty((1, count_of_numbers(60)))
    numbers_of(np.ascontiguousarray(observation), numbers)
    d, covariance = numbers[0] - normal.mean, np.linalg.inv(normal.precision)
    off = Watch(normal, Robot()).look(observation, np.zeros(1, MEMORY)).off[0, SURPRISE]
    for sensor, name in enumerate(GROUPS):
        where = layout(1).slice(name)
        own = [*range(where.start, where.stop)]
        own += [60 + sensor] if sensor < 4 else [*range(64 + 3 * (sensor - 4), 67 + 3 * (sensor - 4))]
        rest = np.setdiff1d(np.arange(len(d)), own)
        marginal = d[rest] @ np.linalg.solve(covariance[np.ix_(rest, rest)], d[rest])
        assert off[sensor] == pytest.approx(d @ normal.precision @ d - marginal, rel=1e-6, abs=1e-6)


def test_it_survives_its_file(normal) -> None:
    again = Normal.from_bytes(normal.to_bytes(), 60)
    for name, array in vars(normal).items():
        assert np.allclose(getattr(again, name), array, rtol=1e-6), name


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mean": np.zeros(3)}, r"mean must be \[73\]"),
        ({"precision": np.eye(72)}, r"precision must be \[73, 73\]"),
        ({"limits": np.full(FLOORS.shape, np.nan)}, "limits must be"),
        ({"limits": np.zeros(FLOORS.shape)}, "limits must be above 0"),
        ({"least": np.full(3, np.inf)}, "least must be"),
    ],
)
def test_what_is_no_normal_is_refused(normal, change, named) -> None:
    with pytest.raises(ValueError, match=named):
        Normal.from_bytes(Normal(**(vars(normal) | change)).to_bytes(), 60)


def test_a_precision_that_is_none_is_refused(normal) -> None:
    none = Normal(**(vars(normal) | {"precision": -normal.precision}))
    with pytest.raises(ValueError, match="precision must be positive definite"):
        Watch(none, Robot())


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 no zip", b"\x93NUMPY"])
def test_what_is_no_file_is_refused(data) -> None:
    with pytest.raises(ValueError, match="no NPZ file"):
        Normal.from_bytes(data, 60)


def test_limits_have_a_floor(normal) -> None:
    assert (calibrate(normal, np.zeros(FLOORS.shape), np.zeros(3)).limits[:2] == FLOORS[:2]).all()


def test_nobody_looks() -> None:
    assert np.isnan(nothing(2).novelty).all()
    assert not nothing(2).any
