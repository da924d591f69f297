"""`lagnet-calibrate`: its promise, what it writes, and how well λ warns."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.console import Console
from scipy.stats import binom, mannwhitneyu

from evaluation import warning
from evaluation.calibrate import CalibrateConfig, Tried, calibrate
from evaluation.errors import CalibrateError
from evaluation.sequence import last_to_pass
from evaluation.warning import Drives, coasting_clearance, false_alarms, judge, labels, lead, onsets
from models import Bundle, BundleError, write_bundle
from monitor import Monitor
from pointgoal.vector import PointGoalVectorEnv
from trainer import checkpoint
from trainer.binomial import most_missed, p_value
from trainer.config import Config
from trainer.features import Features, surroundings
from trainer.train import train

QUIET = Console(quiet=True)


@pytest.mark.parametrize("rates", [np.geomspace(0.0005, 0.05, 12), np.full(12, 0.0101)])
def test_the_promise_fails_no_more_often_than_it_says(rates) -> None:
    """A thousand calibrations of gates whose miss rates are known: rising, and all just too high."""
    rng = np.random.default_rng(0)
    miss_rate, confidence, episodes = 0.01, 0.9, 532
    allowed = most_missed(episodes, miss_rate, confidence)
    chosen = [last_to_pass(rates, lambda rate: rng.binomial(episodes, rate) <= allowed) for _ in range(1000)]
    broken = sum(rate is not None and rate > miss_rate for rate in chosen)
    assert broken <= binom.ppf(1 - 1e-4, 1000, 1.0 - confidence)
    if rates[0] > miss_rate:
        assert broken > 50
    else:
        assert sum(rate is not None for rate in chosen) > 950


def test_how_many_may_be_missed() -> None:
    assert [most_missed(n, 0.01, 0.95) for n in (298, 299, 472, 473)] == [-1, 0, 0, 1]
    assert p_value(0, 299, 0.01) == pytest.approx(0.99**299)
    tried = []
    assert last_to_pass([1, 2, 3, 4], lambda c: tried.append(c) or c != 3) == 2
    assert tried == [1, 2, 3]
    assert last_to_pass([1], lambda c: False) is None


def fake(results: dict[float, int], monkeypatch) -> list:
    """Gates that miss so many episodes, by threshold, instead of the loop; what was run."""
    ran = []

    class Workers:
        def __init__(self, config: CalibrateConfig) -> None:
            pass

        def __enter__(self):
            def run(gate, number, done, count=1000):
                ran.append((gate, number))
                missed = results[gate.threshold] if gate.floor else 0
                return Tried(gate, missed, 3 if not gate.floor else 0, 0.2, 24.0, (0.75, 0.25, 0.5))

            return run

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr("evaluation.calibrate._workers", Workers)
    return ran


def test_the_last_gate_that_passes_is_written_into_the_bundle(
    tiny_bundle: Path, tmp_path, monkeypatch
) -> None:
    path = shutil.copytree(tiny_bundle, tmp_path / tiny_bundle.name)
    before = Bundle.load(path)
    ran = fake({0.1: 0, 0.2: 4, 0.3: 5, 0.4: 0}, monkeypatch)
    config = CalibrateConfig(path, thresholds=(0.1, 0.2, 0.3, 0.4), episodes=1000, dwell=7, hysteresis=0.5)
    manifest, tried = calibrate(config, QUIET)
    assert (manifest.threshold, manifest.hysteresis, manifest.dwell) == (0.2, 0.5, 7)
    found = manifest.calibration
    assert (found.missed, found.tried, found.episodes, found.violated_without_floor) == (4, 3, 1000, 3)
    assert [one.gate.threshold for one in tried] == [0.1, 0.2, 0.3, 0.2]
    assert [gate.floor for gate, _ in ran] == [True, True, True, False, True]
    assert ran[-1][0] == ran[1][0]
    assert found.scores == (0.25, 0.5, 0.75)
    # Fresh episodes for each: no two gates share any, and those to compare with are not the gate's own.
    assert len({number for _, number in ran}) == 5
    after = Bundle.load(path)
    assert (after.policy, after.multiplier) == (before.policy, before.multiplier)
    gate = Monitor.load(path).gate
    assert (gate.threshold, gate.hysteresis, gate.dwell, gate.floor) == (0.2, 0.5, 7, True)
    model = onnx.load_model_from_string(after.multiplier)
    model.doc_string = "another"
    other = model.SerializeToString()
    with pytest.raises(BundleError, match="another multiplier"):
        write_bundle(tmp_path / "b", after.policy, other, manifest)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"episodes": 298}, "299 are needed"),
        ({"miss_rate": 0.0}, "--miss-rate"),
        ({"confidence": 1.0}, "--confidence"),
        ({"thresholds": (0.2, 0.1)}, "--thresholds must rise"),
        ({"thresholds": ()}, "--thresholds must rise"),
        ({"dwell": -1}, "--dwell"),
        ({"episodes": 0}, "--episodes"),
        ({"thresholds": (0.3, 0.4)}, "no gate: the most open one"),
    ],
)
def test_what_can_promise_nothing_is_refused_and_the_bundle_is_as_it_was(
    tiny_bundle: Path, monkeypatch, changes, named
) -> None:
    fake({0.3: 5, 0.4: 0}, monkeypatch)
    before = (tiny_bundle / "manifest.json").read_bytes()
    with pytest.raises(CalibrateError, match=named):
        calibrate(CalibrateConfig(tiny_bundle, **{"thresholds": (0.3,), **changes}), QUIET)
    assert (tiny_bundle / "manifest.json").read_bytes() == before


def test_a_bundle_that_cannot_be_written_is_refused_before_anything_is_run(own_bundle, monkeypatch) -> None:
    (own_bundle / "notes.txt").write_text("mine")
    ran = fake({0.3: 0}, monkeypatch)
    with pytest.raises(BundleError, match=r"holds notes\.txt"):
        calibrate(CalibrateConfig(own_bundle, thresholds=(0.3,)), QUIET)
    assert not ran


def test_it_runs_as_it_is_typed(tiny_bundle: Path, tmp_path: Path) -> None:
    path = shutil.copytree(tiny_bundle, tmp_path / tiny_bundle.name)
    command = [sys.executable, "-m", "evaluation.calibrate", str(path), "--episodes", "3", "--processes", "1"]
    asked = ["--miss-rate", "0.9", "--confidence", "0.5", "--thresholds", "0", "1e9"]
    result = subprocess.run([*command, *asked], capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr
    assert "threshold 0: missed 0" in result.stderr
    assert Bundle.load(path).manifest.calibration.episodes == 3


@st.composite
def drives(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    shape = (draw(st.integers(30, 60)), draw(st.integers(1, 4)))
    cost = draw(arrays(np.float64, shape, elements=st.sampled_from([0.0] * 6 + [0.1])))
    return cost, draw(arrays(np.float64, shape, elements=st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])))


@given(both=drives(), steps=st.integers(1, 20))
def test_auroc_is_that_of_mann_and_whitney(both, steps) -> None:
    cost, score = both
    soon, counted = labels(cost, steps)
    for t in range(len(cost)):
        for e in range(cost.shape[1]):
            if counted[t, e]:
                assert soon[t, e] == (cost[t : t + steps, e] > 0.0).any()
                assert t == 0 or cost[t - 1, e] == 0.0
    hits, misses = score[soon & counted], score[~soon & counted]
    area, precision = warning._Ranked.of(score, soon, counted).quality(np.ones(cost.shape[1]))
    if hits.size and misses.size:
        expected = mannwhitneyu(hits, misses).statistic / (hits.size * misses.size)
        assert area == pytest.approx(expected)
        assert hits.size / (hits.size + misses.size) - 1e-9 <= precision + (area < 0.5) <= 2.0
    else:
        assert np.isnan(area)


def test_alarms_lead_and_onsets() -> None:
    cost = np.zeros((500, 1))
    cost[[200, 201, 400], 0] = 0.1
    assert onsets(cost) == [(200, 0), (400, 0)]
    above = np.zeros((500, 1), bool)
    above[150:260, 0] = True  # 1 s ahead of the first one, and over before the second
    above[20:30, 0] = True  # no violation within 2 s
    assert lead(cost, above) == pytest.approx((0.1, 0.5, 0.9))
    counted = labels(cost, 100)[1].sum()
    assert false_alarms(cost, above) == pytest.approx(3600.0 / (counted * 0.02))


def test_a_score_that_knows_is_perfect_and_noise_is_not() -> None:
    rng = np.random.default_rng(3)
    cost = (rng.random((400, 6)) < 0.004) * 0.1
    knows = -np.array([[np.argmax(np.append(cost[t:, e], 1.0) > 0.0) for e in range(6)] for t in range(400)])
    made = Drives(cost, {"knows": knows.astype(float), "noise": rng.random(cost.shape)})
    knowing, noise = judge(made, "knows", 0), judge(made, "noise", 0)
    for value, low, high in knowing.auroc.values():
        assert (value, low, high) == pytest.approx((1.0, 1.0, 1.0))
    value, low, high = noise.auroc["0.5"]
    assert low < 0.5 < high
    assert low < value < high
    assert knowing.alarms_per_hour <= noise.alarms_per_hour


def test_coasting_clearance_by_hand() -> None:
    velocity = np.array([[1.0, 0.0], [0.0, 0.0]])
    hazards = np.array([[[0.3, 0.1], [2.0, 0.0]], [[0.3, 0.4], [np.inf, 0.0]]])
    with np.errstate(invalid="ignore"):
        assert coasting_clearance(velocity[:1], hazards[:1]) == pytest.approx([0.1])
    assert coasting_clearance(velocity[1:], hazards[1:, :1]) == pytest.approx([0.5])


def test_a_report_is_written(tmp_path: Path) -> None:
    config = CalibrateConfig(Path("models/pointgoal1"), episodes=6, report=tmp_path / "deep" / "er")
    shown = warning.report(config, QUIET)
    assert shown.row_count == len(warning.SCORES)
    content = json.loads((config.report / "warning.json").read_text())
    assert set(content["scores"]) == set(warning.SCORES)
    for quality in content["scores"].values():
        for value, low, high in quality["auroc"].values():
            assert 0.0 <= low <= value <= high <= 1.0
    assert (config.report / "warning.png").stat().st_size > 20_000


def trained(folder: Path, **changes: object) -> Path:
    """A run of two epochs."""
    small = {"total_steps": 400, "num_envs": 4, "epoch_steps": 200, "minibatch": 100, "passes": 1}
    config = Config(**{"threads": 1, "tensorboard": False, "out": folder, **small, **changes})
    train(config)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return trained(tmp_path_factory.mktemp("runs") / "run")


def test_the_cost_critic_is_that_of_the_checkpoint(run: Path) -> None:
    """By hand: the second row of the critics, two layers of tanh, on the features of what it observes."""
    env = PointGoalVectorEnv(1, 5, num_threads=1)
    observation, _ = env.reset(seed=0)
    env.close()
    arrays, _ = checkpoint.read(run)
    features = Features(60, surroundings(Config()))
    state = {name: arrays[f"learner.normaliser.{name}"] for name in ("mean", "variance", "count")}
    features.normaliser.restore(state["mean"], state["variance"], float(state["count"]))
    layer = features(torch.from_numpy(observation.astype(np.float32))).detach().numpy()
    rest = arrays["learner.critics"][1]
    for k, width in enumerate((64, 64, 1)):
        weights, biases, rest = np.split(rest, [layer.shape[1] * width, (layer.shape[1] + 1) * width])
        layer = layer @ weights.reshape(-1, width) + biases
        layer = np.tanh(layer) if k < 2 else layer
    found = warning.cost_critic(run, Bundle.load("models/pointgoal1"))(observation)
    np.testing.assert_allclose(found, layer[:, 0], atol=1e-5)
    assert np.ptp(found) > 0.0


def test_a_report_with_a_run_has_its_cost_critic_and_is_else_the_same(run: Path, tmp_path: Path) -> None:
    config = CalibrateConfig(Path("models/pointgoal1"), episodes=4, report=tmp_path / "with", run=run)
    assert warning.report(config, QUIET).row_count == len(warning.SCORES) + 1
    warning.report(replace(config, report=tmp_path / "without", run=None), QUIET)
    one, other = (json.loads((tmp_path / name / "warning.json").read_text()) for name in ("with", "without"))
    critic = one["scores"].pop("cost critic")
    assert one == other
    assert all(0.0 <= low <= value <= high <= 1.0 for value, low, high in critic["auroc"].values())
    assert critic["auroc"] not in [quality["auroc"] for quality in one["scores"].values()]
    pictures = [(tmp_path / name / "warning.png").read_bytes() for name in ("with", "without")]
    assert pictures[0] != pictures[1]


def test_a_run_that_has_no_critic_for_the_bundle_is_refused(run: Path, tmp_path: Path) -> None:
    bare = shutil.copytree(run, tmp_path / "bare")
    (bare / checkpoint.FILE).unlink()
    cut = shutil.copytree(run, tmp_path / "cut")
    (cut / checkpoint.FILE).write_bytes((run / checkpoint.FILE).read_bytes()[:-100])
    for folder, named in (
        (tmp_path / "nowhere", "nowhere is no run"),
        (bare, "bare holds no checkpoint"),
        (cut, "damaged"),
        (trained(tmp_path / "other", task="PointGoal2-v0"), "of task PointGoal2-v0, .* of PointGoal1-v0"),
        (trained(tmp_path / "scpo", algorithm="scpo"), "scpo observes more"),
    ):
        asked = CalibrateConfig(Path("models/pointgoal1"), episodes=2, report=tmp_path / "out", run=folder)
        with pytest.raises(CalibrateError, match=f"--run.*{named}") as error:
            warning.report(asked, QUIET)
        assert len(str(error.value).splitlines()) == 1
        assert not (tmp_path / "out").exists()
