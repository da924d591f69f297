"""A gate chosen from a robot's own logs, and whether new logs still look like those it was chosen on."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from decision import MOST_OPEN
from evaluation import calibrate as command
from evaluation.calibrate import CalibrateConfig, check_flags
from evaluation.errors import CalibrateError
from evaluation.logs import read_log
from evaluation.recorded import _of_the_loop, calibrate_on_logs, check_logs
from inference import Networks
from models import Bundle, Calibration, write_bundle
from monitor import Gate, Monitor
from pointgoal.loop import drive
from pointgoal.vector import PointGoalVectorEnv

STEPS, BEGINS = 50, 40
"""Of a recorded episode; where its violation begins, if it has one."""


def record(
    path: Path, violating: int, quiet: int = 0, seed: int = 0, scale: float = 1.0, **changes: object
) -> Path:
    """Writes a log as a robot would; some episodes have a violation. ``changes`` are other arrays."""
    rng = np.random.default_rng(seed)
    episodes = violating + quiet
    cost = np.zeros((episodes, STEPS))
    cost[:violating, BEGINS:] = 0.1
    arrays: dict[str, object] = {
        "observation": scale * rng.normal(size=(episodes * STEPS, 60)).astype(np.float32),
        "cost": cost.reshape(-1),
        "episode": np.repeat(np.arange(episodes), STEPS),
    }
    np.savez(path, **{name: value for name, value in (arrays | changes).items() if value is not None})
    return path


def asked(bundle: Path, *logs: Path, **changes: object) -> CalibrateConfig:
    settings: dict[str, object] = {"miss_rate": 0.1, "confidence": 0.9}
    return CalibrateConfig(bundle, log=logs, **{**settings, **changes})


def smallest(bundle: Path, log: Path, violating: int) -> np.ndarray:
    """By hand: the least λ in the 0.6 s, 30 steps, before each violation, and where it begins."""
    with np.load(log) as file:
        _, risk = Networks(Bundle.load(bundle)).run(file["observation"])
    return risk.reshape(-1, STEPS)[:violating, BEGINS - 30 : BEGINS + 1].min(axis=1)


def test_the_threshold_is_the_order_statistic_and_the_manifest_says_so(own_bundle: Path, tmp_path) -> None:
    before = Bundle.load(own_bundle)
    logs = [record(tmp_path / "a.npz", 30, 5), record(tmp_path / "b.npz", 20, 0, seed=1)]
    manifest = calibrate_on_logs(asked(own_bundle, *logs, hysteresis=0.5, dwell=4))
    scores = np.sort(np.r_[smallest(own_bundle, logs[0], 30), smallest(own_bundle, logs[1], 20)])
    # BinomCDF(1; 50, 0.1) = 0.034 ≤ 0.1 < 0.112 = BinomCDF(2; 50, 0.1): the second smallest.
    assert scores[0] < manifest.threshold < scores[1]
    assert manifest.threshold == pytest.approx(scores[1])
    found = manifest.calibration
    assert (found.method, found.miss_rate, found.confidence) == ("onset", 0.1, 0.9)
    assert (found.episodes, found.violating, found.missed) == (55, 50, 1)
    assert found.logs == tuple(hashlib.sha256(log.read_bytes()).hexdigest() for log in logs)
    assert found.scores == pytest.approx(np.sort(1.0 / (1.0 + scores)))
    assert found.seed is found.tried is found.hazards is None
    for word in ("onset", "all but 1 of 50 violating of 55 recorded", "2 logs", "10%", "90%"):
        assert word in manifest.threshold_source
    after = Bundle.load(own_bundle)
    assert (after.policy, after.multiplier) == (before.policy, before.multiplier)
    assert after.manifest == manifest
    assert Monitor.load(own_bundle).gate == Gate("risk", manifest.threshold, 0.5, 4)
    # What the other form alone has does not stand there as null.
    assert "tried" not in (own_bundle / "manifest.json").read_text()


def test_episodes_of_many_lengths_and_as_many_scores_as_are_kept(own_bundle: Path, tmp_path) -> None:
    rng = np.random.default_rng(0)
    lengths = rng.integers(35, 60, 230)
    episode = np.repeat(rng.permutation(1000)[:230], lengths)
    cost = np.zeros(len(episode), np.bool_)
    cost[np.cumsum(lengths) - 1] = True
    observation = rng.normal(size=(len(episode), 60))
    log = record(tmp_path / "a.npz", 1, observation=observation, cost=cost, episode=episode)
    manifest = calibrate_on_logs(asked(own_bundle, log))
    found = manifest.calibration
    assert (found.episodes, found.violating, len(found.scores)) == (230, 230, 200)
    _, risk = Networks(Bundle.load(own_bundle)).run(observation)
    ends = np.cumsum(lengths)
    scores = np.array([risk[end - 31 : end].min() for end in ends])
    assert (scores <= manifest.threshold).sum() == found.missed
    assert {round(s, 9) for s in found.scores} <= {round(s, 9) for s in 1.0 / (1.0 + scores)}


ROWS = 40 * STEPS
WRONG_ARRAYS = {
    "no such array": ({"cost": None}, "no array cost: .*; has episode, observation"),
    "another layout": ({"observation": np.zeros((ROWS, 59))}, r"observation must have shape \(T, 60\)"),
    "one row": ({"observation": np.zeros(60)}, r"observation must have shape \(T, 60\)"),
    "no rows": ({"observation": np.zeros((0, 60))}, "T at least 1"),
    "a table of costs": ({"cost": np.zeros((40, STEPS))}, r"cost must have shape \(2000,\)"),
    "a cost is missing": ({"cost": np.zeros(ROWS - 1)}, r"cost must have shape \(2000,\)"),
    "an episode is missing": ({"episode": np.zeros(ROWS + 1)}, r"episode must have shape \(2000,\)"),
    "cost not finite": ({"cost": np.r_[0, np.nan, np.zeros(ROWS - 2)]}, r"cost\[1\] must be a finite"),
    "cost negative": ({"cost": np.r_[-1, np.zeros(ROWS - 1)]}, "cost must be at least 0, got -1 in row 0"),
    "texts": ({"cost": np.full(ROWS, "0.1")}, "cost must be numbers"),
    "objects": ({"cost": np.array([None] * ROWS)}, "cost must be an array of numbers"),
    "complex": ({"observation": np.zeros((ROWS, 60), complex)}, "observation must be numbers"),
    "halves": ({"episode": np.arange(ROWS) // STEPS + 0.5}, "must be whole numbers, got 0.5 in row 0"),
    "comes again": ({"episode": np.arange(ROWS) // STEPS % 20}, "episode 0 begins again in row 1000"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG_ARRAYS)
def test_a_log_that_is_not_in_order_is_named(own_bundle: Path, tmp_path: Path, wrong: str) -> None:
    changes, named = WRONG_ARRAYS[wrong]
    refused(own_bundle, named, record(tmp_path / "tuesday.npz", 40, **changes))


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e39])
def test_an_observation_that_no_network_can_take_is_named(own_bundle: Path, tmp_path, value) -> None:
    observation = np.zeros((ROWS, 60))
    observation[12, 3] = value
    log = record(tmp_path / "tuesday.npz", 40, observation=observation)
    refused(own_bundle, r"observation\[12, 3\] must be a finite number of float32", log)


def refused(bundle: Path, named: str, *logs: Path, **changes: object) -> None:
    """It is one line, and the bundle is as it was."""
    before = (bundle / "manifest.json").read_bytes()
    with pytest.raises(CalibrateError, match=named) as error:
        calibrate_on_logs(asked(bundle, *logs, **changes))
    assert len(str(error.value).splitlines()) == 1
    assert "tuesday" not in str(logs) or f"--log {logs[0]}" in str(error.value)
    assert (bundle / "manifest.json").read_bytes() == before


def test_files_that_are_no_logs_are_named(own_bundle: Path, tmp_path: Path) -> None:
    refused(own_bundle, "No such file", tmp_path / "tuesday.npz")
    (tmp_path / "folder.npz").mkdir()
    refused(own_bundle, "Is a directory", tmp_path / "folder.npz")
    (tmp_path / "text.npz").write_text("episode,cost\n")
    (tmp_path / "nothing.npz").write_bytes(b"")
    np.save(tmp_path / "single.npy", np.zeros((5, 60)))
    whole = record(tmp_path / "whole.npz", 40).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[:-3000])
    (tmp_path / "flipped.npz").write_bytes(whole[:5000] + bytes([whole[5000] ^ 0xFF]) + whole[5001:])
    for name in ("text.npz", "nothing.npz", "single.npy", "cut.npz", "flipped.npz"):
        refused(own_bundle, "expected an .npz", tmp_path / name)


def test_what_is_missing_for_a_promise_is_said(own_bundle: Path, tmp_path: Path) -> None:
    few, enough = record(tmp_path / "few.npz", 21, 30), record(tmp_path / "enough.npz", 40)
    refused(own_bundle, "21 of 51 calibration episodes had a violation, 22 are needed", few)
    refused(own_bundle, "0 of 30 .* 22 are needed", record(tmp_path / "none.npz", 0, 30))
    refused(own_bundle, "299 are needed", enough, miss_rate=0.01, confidence=0.95)
    refused(own_bundle, "would count twice", enough, few, enough)
    refused(own_bundle, "--miss-rate must be between 0 and 1", enough, miss_rate=1.0)
    refused(own_bundle, "--confidence must be between 0 and 1", enough, confidence=float("nan"))
    refused(own_bundle, "--hysteresis must be above 0", enough, hysteresis=0.0)
    refused(own_bundle, "--dwell must be", enough, dwell=MOST_OPEN + 1)
    # Violations before any lead: no threshold sees them coming.
    early = np.zeros((40, STEPS))
    early[:, 5] = 1.0
    refused(own_bundle, "λ was not above 0 for 0.6 s", record(tmp_path / "e.npz", 40, cost=early.reshape(-1)))
    same = np.zeros((ROWS, 60))
    refused(own_bundle, "in every row", record(tmp_path / "same.npz", 40, observation=same))


@pytest.fixture
def calibrated(own_bundle: Path, tmp_path: Path) -> Path:
    calibrate_on_logs(asked(own_bundle, record(tmp_path / "calibration.npz", 80)))
    return own_bundle


def test_new_logs_of_the_same_robot_raise_no_alarm_and_others_do(calibrated: Path, tmp_path: Path) -> None:
    before = (calibrated / "manifest.json").read_bytes()
    same = [record(tmp_path / f"{k}.npz", 30, 10, seed=k) for k in (1, 2)]
    found = check_logs(asked(calibrated, *same, check=True))
    assert found.alarmed is None
    assert (found.episodes, len(found.scored), found.test.episodes) == (80, 60, 60)
    # Sensors with a third of their range: λ, a softplus, is nearer to log 2.
    other = record(tmp_path / "other.npz", 30, 10, seed=3, scale=0.33)
    found = check_logs(asked(calibrated, *same, other, check=True))
    assert found.alarmed is not None
    path, episode = found.alarmed
    assert path == other
    assert 6 <= episode <= 25
    assert (calibrated / "manifest.json").read_bytes() == before


def test_what_cannot_be_checked_is_refused(own_bundle: Path, tmp_path: Path) -> None:
    log, new = record(tmp_path / "calibration.npz", 80), record(tmp_path / "new.npz", 20, seed=1)
    with pytest.raises(CalibrateError, match="was not calibrated"):
        check_logs(asked(own_bundle, new))
    manifest = calibrate_on_logs(asked(own_bundle, log))
    with pytest.raises(CalibrateError, match=r"calibration\.npz: is one that the gate was calibrated on"):
        check_logs(asked(own_bundle, new, log))
    with pytest.raises(CalibrateError, match=r"3 episodes with a violation .* at least 6 are needed"):
        check_logs(asked(own_bundle, record(tmp_path / "few.npz", 3, 50)))
    with pytest.raises(CalibrateError, match="--confidence"):
        check_logs(asked(own_bundle, new, confidence=1.0))
    with pytest.raises(CalibrateError, match="no array cost"):
        check_logs(asked(own_bundle, record(tmp_path / "bare.npz", 20, cost=None)))
    bundle = Bundle.load(own_bundle)
    old = manifest.model_copy(
        update={"calibration": manifest.calibration.model_copy(update={"scores": None})}
    )
    write_bundle(own_bundle, bundle.policy, bundle.multiplier, old)
    with pytest.raises(CalibrateError, match="before scores were kept"):
        check_logs(asked(own_bundle, new))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"check": True}, "--check needs the logs"),
        ({"run": Path("r")}, "--run adds"),
        ({"report": Path("r"), "log": (Path("a"),)}, "--report measures"),
        *(
            ({"log": (Path("a"),), name: value}, f"--{name} has no meaning with --log")
            for name, value in (("seed", 3), ("episodes", 5), ("hazards", "given"), ("thresholds", (0.1,)))
        ),
        *(
            ({"log": (Path("a"),), "check": True, name: value}, f"{name[:4]}.* has no meaning with --check")
            for name, value in (("miss_rate", 0.3), ("dwell", 5), ("hysteresis", 1.0))
        ),
    ],
)
def test_a_setting_that_would_be_ignored_is_refused(changes, named) -> None:
    with pytest.raises(CalibrateError, match=named):
        check_flags(CalibrateConfig(Path("models/pointgoal1"), **changes))


def typed(*arguments: object) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "evaluation.calibrate", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)


def test_it_runs_as_it_is_typed(own_bundle: Path, tmp_path: Path) -> None:
    first, second = record(tmp_path / "a.npz", 40), record(tmp_path / "b.npz", 40, seed=1)
    result = typed(own_bundle, "--log", first, "--log", second, "--miss-rate", 0.05, "--dwell", 3)
    assert result.returncode == 0, result.stderr
    assert "onset: λ was above it for 0.6 s" in result.stderr
    manifest = Bundle.load(own_bundle).manifest
    assert (manifest.calibration.violating, manifest.dwell, manifest.hysteresis) == (80, 3, 0.33)
    result = typed(own_bundle, "--check", "--log", record(tmp_path / "c.npz", 20, scale=0.33))
    assert result.returncode == 1, result.stderr
    assert "no longer applies: alarm in episode" in result.stderr
    result = typed(own_bundle, "--log", tmp_path / "nowhere.npz")
    assert (result.returncode, len(result.stderr.strip().splitlines())) == (2, 1)


def seen(observe, count: int, first: int) -> np.ndarray:
    """What robots watched by the shipped gate see [T, N, 60]; `observe` may spoil it before they do."""
    monitor = Monitor.load("models/pointgoal1")
    env, memory, rows = PointGoalVectorEnv(1, count, num_threads=1), None, []

    def act(observation, _):
        nonlocal memory
        rows.append(observe(observation))
        decisions = monitor.decide_batch(rows[-1], memory=memory)
        memory = decisions.memory
        return decisions.action

    for _ in drive(env, act, range(first, first + count)):
        pass
    env.close()
    return np.array(rows)


def blind(observation: np.ndarray) -> np.ndarray:
    """With a hazards' lidar that shows nothing."""
    return np.where((np.arange(60) >= 28) & (np.arange(60) < 44), 0.0, observation)


def write(path: Path, rows: np.ndarray) -> Path:
    """A log without costs of what robots saw [T, N, 60]."""
    steps, robots = rows.shape[:2]
    observation = rows.swapaxes(0, 1).reshape(-1, 60)
    return record(path, 1, observation=observation, cost=None, episode=np.repeat(np.arange(robots), steps))


def test_the_closed_loops_calibration_is_checked_by_logs_of_that_loop(tmp_path: Path) -> None:
    shipped = Bundle.load("models/pointgoal1")
    config = CalibrateConfig(Path("models/pointgoal1"))
    gate = Monitor.load("models/pointgoal1").gate
    part = command._episodes(config, gate, 0, 25)
    calibration = shipped.manifest.calibration.model_copy(update={"scores": tuple(sorted(part.silences))})
    manifest = shipped.manifest.model_copy(update={"calibration": calibration})
    path = write_bundle(
        tmp_path / "pointgoal1", shipped.policy, shipped.multiplier, manifest, shipped.novelty
    ).path

    rows = seen(np.array, 12, 50)
    found = check_logs(asked(path, write(tmp_path / "same.npz", rows), confidence=0.95))
    assert found.alarmed is None
    assert len(found.scored) == found.episodes == 12
    spoilt = write(tmp_path / "blind.npz", seen(blind, 12, 70))
    assert check_logs(asked(path, spoilt, confidence=0.95)).alarmed is not None


def test_the_loop_is_scored_as_its_log_is(tmp_path: Path) -> None:
    monitor = Monitor.load("models/pointgoal1")
    listening, log = command._Listening(monitor, 3), []
    env, memory = PointGoalVectorEnv(1, 3, num_threads=1), None

    def act(observation, env):
        nonlocal memory
        log.append(observation.copy())
        decisions = listening.decide_batch(observation, env.hazards_in_body_frame(), memory)
        memory = decisions.memory
        return decisions.action

    for _ in drive(env, act, [4, 5, 6]):
        pass
    env.close()
    bundle = monitor.bundle
    logged = read_log(write(tmp_path / "log.npz", np.array(log)), 60, costs=False)
    assert _of_the_loop(bundle, [logged]) == pytest.approx(listening.silences.tolist(), abs=1e-5)
    assert len(set(listening.silences)) == 3


CLOSED = {
    "method": "closed loop", "miss_rate": 0.1, "confidence": 0.9, "episodes": 50, "missed": 0,
    "multiplier": "0" * 64, "hazards": "lidar", "tried": 1, "seed": 0,
}  # fmt: skip
ONSET = {key: CLOSED[key] for key in ("miss_rate", "confidence", "episodes", "missed", "multiplier")} | {
    "method": "onset",
    "violating": 40,
    "logs": ("1" * 64,),
}


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        (CLOSED | {"violating": 3}, "violating"),
        (CLOSED | {"logs": ("1" * 64,)}, "logs"),
        (CLOSED | {"tried": None}, "tried"),
        (CLOSED | {"scores": (1.5,)}, "scores"),
        (CLOSED | {"scores": ()}, "scores"),
        (CLOSED | {"scores": (0.5,) * 201}, "scores"),
        (ONSET | {"seed": 0}, "seed"),
        (ONSET | {"violated_without_floor": 0}, "violated_without_floor"),
        (ONSET | {"logs": None}, "logs"),
        (ONSET | {"logs": ("monday",)}, "logs"),
        (ONSET | {"violating": None}, "violating"),
    ],
)
def test_a_calibration_has_what_its_form_has(fields, named) -> None:
    assert Calibration.model_validate(CLOSED).violated_without_floor is None
    assert Calibration.model_validate(ONSET).scores is None
    with pytest.raises(ValueError, match=named):
        Calibration.model_validate(fields)
