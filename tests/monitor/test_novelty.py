"""The monitor and a sensor that fails: the gate opens or the plan goes on, and the decision says why."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from decision import MEMORY, Mode, OpenedBy, pack, unpack
from models import Bundle, BundleError, write_bundle
from monitor import Monitor
from pointgoal.observation import layout

SHIPPED = Path(__file__).parents[2] / "models" / "pointgoal1"
N, BEFORE = 16, 60


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load(SHIPPED)


@pytest.fixture(scope="module")
def under_way(bundle, drive):
    """Robots that have driven for a while behind a healthy monitor: observations, hazards, memory."""
    monitor, memory = Monitor.load(bundle), np.zeros(N, MEMORY)
    for now in drive(BEFORE, n=N):
        if now.step == BEFORE:
            break
        decided = monitor.decide_batch(now.observation, None, memory)
        assert (decided.novelty <= 1.0).all()
        assert (decided.suspect == "").all()
        now.action, memory = decided.action, decided.memory
    return now.observation, memory


def test_a_healthy_robot_is_not_novel(bundle, under_way) -> None:
    decided = Monitor.load(bundle).decide_batch(under_way[0], None, under_way[1])
    assert (decided.novelty < 1.0).all()
    assert not (decided.opened_by == OpenedBy.NOVELTY).any()


@pytest.mark.parametrize("sensor", ["velocimeter", "hazards_lidar"])
@pytest.mark.parametrize("gate", ["risk", "always"])
def test_without_a_sensor_that_it_steers_by_the_plan_goes_on(bundle, under_way, sensor, gate) -> None:
    observation, memory = under_way[0].copy(), under_way[1]
    moving = np.hypot(*observation[:, layout(1).slice("velocimeter")].T[:2]) > 0.2
    assert moving.sum() > N // 2
    observation[:, layout(1).slice(sensor)] = 0.0
    monitor = Monitor.load(bundle, gate)
    planned = memory["plan"][:, 0] * (memory["left"] > 0)[:, None]
    decided = monitor.decide_batch(observation, None, memory)
    for k in np.flatnonzero(moving):
        one = decided[int(k)]
        assert (one.mode, one.opened_by, one.suspect) == (Mode.FALLBACK, OpenedBy.NOVELTY, sensor)
        assert one.novelty > 1.0
        assert np.isnan(one.barrier)
        assert f"the {sensor} shows what it should not: the plan goes on" == one.reason
        assert one.action.tolist() == pytest.approx(planned[k].tolist())
    assert monitor.faults.counts[f"novelty: {sensor}"] == 1
    # It is not trusted again as soon as it is well: the plan runs out, and the robot coasts.
    for _ in range(25):
        decided = monitor.decide_batch(under_way[0], None, decided.memory)
    assert (decided.mode[moving] == Mode.FALLBACK).all()
    assert (decided.action[moving] == 0.0).all()


def test_a_sensor_that_it_does_not_steer_by_opens_the_gate(bundle, under_way) -> None:
    observation = under_way[0].copy()
    observation[:, layout(1).slice("accelerometer")] = 0.0
    decided = Monitor.load(bundle).decide_batch(observation, None, under_way[1])
    assert (decided.opened_by == OpenedBy.NOVELTY).all()
    assert (decided.suspect == "accelerometer").all()
    assert (decided.mode != Mode.FALLBACK).all()


def test_with_the_gate_off_it_is_only_told(bundle, under_way) -> None:
    observation = under_way[0].copy()
    observation[:, layout(1).slice("hazards_lidar")] = 0.0
    decided = Monitor.load(bundle, "off").decide_batch(observation, None, under_way[1])
    assert (decided.mode == Mode.NOMINAL).all()
    assert (decided.suspect == "hazards_lidar").all()


def test_what_is_not_trusted_survives_the_wire(bundle, under_way) -> None:
    observation = under_way[0][:1].copy()
    observation[:, layout(1).slice("hazards_lidar")] = 0.0
    monitor = Monitor.load(bundle)
    memory = monitor.decide_batch(observation, None, under_way[1][:1]).memory
    again = unpack(pack(memory.tobytes()))
    assert again["history"].tobytes() == memory["history"].tobytes()
    assert monitor.decide(under_way[0][0], None, again).mode == Mode.FALLBACK


def test_nobody_looks_without_what_is_normal(bundle, under_way) -> None:
    blind = Monitor.load(replace(bundle, novelty=None))
    observation = under_way[0].copy()
    observation[:, layout(1).slice("accelerometer")] = 0.0
    decided = blind.decide_batch(observation, None, under_way[1])
    assert np.isnan(decided.novelty).all()
    assert (decided.suspect == "").all()


def test_a_bundle_that_lost_what_is_normal_is_refused(bundle, tmp_path) -> None:
    copied = tmp_path / "pointgoal1"
    shutil.copytree(bundle.path, copied)
    (copied / "novelty.npz").write_bytes(b"?")
    with pytest.raises(BundleError, match=r"novelty\.npz: sha256 is"):
        Bundle.load(copied)
    (copied / "novelty.npz").unlink()
    with pytest.raises(BundleError, match=r"novelty\.npz: cannot be read"):
        Monitor.load(copied)


def test_it_comes_with_its_source_or_not_at_all(bundle, tmp_path) -> None:
    files = bundle.policy, bundle.multiplier
    with pytest.raises(BundleError, match="come together or not at all"):
        write_bundle(tmp_path / "a", *files, bundle.manifest)
    without = bundle.manifest.model_copy(update={"novelty": None})
    with pytest.raises(BundleError, match="come together or not at all"):
        write_bundle(tmp_path / "a", *files, without, bundle.novelty)
    assert write_bundle(tmp_path / "a", *files, without).novelty is None
    assert write_bundle(tmp_path / "b", *files, bundle.manifest, bundle.novelty).novelty == bundle.novelty
