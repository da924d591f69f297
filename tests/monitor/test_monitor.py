"""One observation in, one decision out: what holds always, and what happens when a part fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from filter import SAFE_ACTION, FilterError, FilterInputError, FilterMemory, Mode
from models import Bundle, write_bundle
from monitor import Monitor, MonitorError, NetworkError

READINGS = st.floats(0.0, 1.0)
MOTION = st.floats(-3.0, 3.0)


@st.composite
def observations(draw: st.DrawFn) -> np.ndarray:
    """Observations [60] that a robot can have: motion of a few metres a second, readings in [0, 1]."""
    return np.concatenate(
        [draw(arrays(np.float64, 12, elements=MOTION)), draw(arrays(np.float64, 48, elements=READINGS))]
    )


HAZARDS = st.none() | st.integers(0, 10).flatmap(
    lambda n: arrays(np.float64, (n, 2), elements=st.floats(-4.0, 4.0))
)


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.tobytes() == b.tobytes()


@settings(max_examples=60, deadline=None)
@given(observation=observations(), hazards=HAZARDS, gate=st.sampled_from(["risk", "always", "off"]))
def test_what_holds_of_every_decision(monitors, observation, hazards, gate) -> None:
    decision = monitors[gate].decide(observation, hazards)
    assert np.isfinite(decision.action).all()
    assert (np.abs(decision.action) <= 1.0).all()
    assert decision.risk >= 0.0
    assert decision.gate_open == (gate == "always" or (gate == "risk" and decision.risk > decision.threshold))
    if decision.mode == "nominal":
        assert same_bits(decision.action, decision.nominal_action)
    if not decision.gate_open:
        assert decision.mode == "nominal"
    assert (decision.reason is None) == (decision.mode != "fallback")


@settings(max_examples=25, deadline=None)
@given(
    rows=st.lists(observations(), min_size=1, max_size=6),
    given_hazards=st.booleans(),
    gate=st.sampled_from(["risk", "always", "off"]),
    seed=st.integers(0, 99),
)
def test_a_batch_decides_as_its_robots_alone(monitors, rows, given_hazards, gate, seed) -> None:
    hazards = np.random.default_rng(seed).uniform(-2, 2, (len(rows), 5, 2)) if given_hazards else None
    batch = monitors[gate].decide_batch(np.array(rows), hazards)
    assert len(batch) == len(rows)
    for i, row in enumerate(rows):
        alone, together = monitors[gate].decide(row, None if hazards is None else hazards[i]), batch[i]
        assert same_bits(alone.action, together.action)
        assert alone.risk == pytest.approx(together.risk, rel=1e-6)
        for name in ("mode", "barrier", "hazard", "row", "reason", "gate_open"):
            assert getattr(alone, name) == getattr(together, name)


def test_the_gate_opens_above_the_threshold_and_not_at_it(build, at_rest) -> None:
    for risk, opens in ((0.5, False), (np.nextafter(0.5, 1.0), True), (0.0, False), (1e30, True)):
        monitor = build(build.networks([[0.1, 0.2]], [risk]), gate="risk", threshold=0.5)
        assert monitor.decide(at_rest).gate_open is opens


def test_with_a_hazard_ahead_the_open_gate_changes_full_thrust_and_the_closed_one_does_not(
    build, at_rest
) -> None:
    at_rest[3] = 1.4
    fast = build.networks([[1.0, 0.0]], [0.0])
    assert build(fast, gate="off").decide(at_rest, [[0.45, 0.0]]).mode == "nominal"
    decision = build(fast, gate="always").decide(at_rest, [[0.45, 0.0]])
    assert decision.mode != "nominal"
    assert decision.hazard == 0
    assert decision.row is not None


@pytest.mark.parametrize("gate", ["risk", "always", "off"])
@pytest.mark.parametrize(
    ("action", "risk"),
    [
        ([[np.nan, 0.0]], [0.0]),
        ([[0.0, np.inf]], [0.0]),
        ([[0.0, 1.1]], [0.0]),
        ([[-np.inf, np.nan]], [np.nan]),
        ([[0.3, 0.3]], [np.nan]),
        ([[0.3, 0.3]], [np.inf]),
        ([[0.3, 0.3]], [-0.1]),
    ],
)
def test_numbers_no_network_should_give_end_in_the_fallback(build, at_rest, gate, action, risk) -> None:
    decision = build(build.networks(action, risk), gate=gate).decide(at_rest)
    assert decision.mode == "fallback"
    assert decision.gate_open
    assert "networks gave" in str(decision.reason)
    assert tuple(decision.action) == SAFE_ACTION


def test_the_rounding_of_float32_is_no_fault(build, at_rest) -> None:
    decision = build(build.networks([[1.0000001, -1.0000001]], [0.0]), gate="off").decide(at_rest)
    assert decision.mode == "nominal"
    assert decision.action.tolist() == [1.0, -1.0]


@pytest.mark.parametrize(("action", "risk"), [([[0.0, 0.0, 0.0]], [0.0]), ([[0.0, 0.0]], [[0.0]]), ([], [])])
def test_networks_of_another_shape_end_in_the_fallback(build, at_rest, action, risk) -> None:
    decision = build(build.networks(action, risk)).decide(at_rest)
    assert decision.mode == "fallback"
    assert tuple(decision.action) == SAFE_ACTION


@pytest.mark.parametrize("gate", ["risk", "always", "off"])
@pytest.mark.parametrize(
    "fault",
    [
        FilterError("broken"),
        FilterInputError("hazards", "broken"),
        RuntimeError("broken"),
        ValueError("broken"),
        ZeroDivisionError("broken"),
        MemoryError("broken"),
        KeyError("broken"),
        np.linalg.LinAlgError("broken"),
    ],
)
def test_a_filter_that_raises_ends_in_the_fallback(build, at_rest, gate, fault) -> None:
    decision = build(action_filter=build.filter(fault), gate=gate).decide(at_rest)
    assert decision.mode == "fallback"
    assert "broken" in str(decision.reason)
    assert tuple(decision.action) == SAFE_ACTION


@pytest.mark.parametrize(
    ("gate", "changes"),
    [
        ("always", {"action": np.array([[np.nan, 0.0]]), "mode": np.array([1], np.int8)}),
        ("always", {"action": np.array([[0.0, 1.5]]), "mode": np.array([1], np.int8)}),
        ("always", {"action": np.zeros((1, 3))}),
        ("always", {"action": np.zeros((2, 2))}),
        ("always", {"action": np.array([[0.01, 0.02]]), "mode": np.array([0], np.int8)}),
        ("off", {"action": np.array([[0.01, 0.02]]), "mode": np.array([1], np.int8)}),
        ("always", {"reason": None}),
        ("always", {"action": None}),
    ],
)
def test_a_filter_that_answers_nonsense_ends_in_the_fallback(build, at_rest, gate, changes) -> None:
    decision = build(action_filter=build.filter(**changes), gate=gate).decide(at_rest)
    assert decision.mode == "fallback"
    assert decision.reason
    assert tuple(decision.action) == SAFE_ACTION


def test_networks_that_cannot_run_end_in_the_fallback(build, at_rest) -> None:
    networks = build.networks([[0.0, 0.0]], [0.0])
    networks.run = lambda observation: (_ for _ in ()).throw(NetworkError("broken"))
    decision = build(networks).decide(at_rest)
    assert decision.mode == "fallback"
    assert decision.reason == "broken"


@pytest.mark.parametrize(
    ("place", "value", "named"),
    [
        (0, np.nan, "observation[0]"),
        (59, np.inf, "observation[59]"),
        (30, -np.inf, "observation[30]"),
        (7, 1e300, "observation[7]"),
    ],
)
@pytest.mark.parametrize("gate", ["risk", "always", "off"])
def test_an_observation_with_no_number_is_named(monitors, at_rest, gate, place, value, named) -> None:
    at_rest[place] = value
    decision = monitors[gate].decide(at_rest)
    assert decision.mode == "fallback"
    assert named in str(decision.reason)
    assert tuple(decision.action) == SAFE_ACTION


@pytest.mark.parametrize(
    "bad", [[], [1.0] * 59, [[0.0] * 60], "abc", ["x"] * 60, None, {}, 3.0, [None] * 60, [[1], [2, 3]]]
)
def test_an_observation_of_another_kind_ends_in_the_fallback(monitors, bad) -> None:
    decision = monitors["off"].decide(bad)
    assert decision.mode == "fallback"
    assert decision.reason
    assert tuple(decision.action) == SAFE_ACTION


@pytest.mark.parametrize(
    "bad",
    [[[1.0]], [[1.0, 2.0, 3.0]], [1.0, 2.0], np.ones((2, 8)), 1.0, "near", [[np.inf, 0.0]], [[np.nan, 0.0]]],
)
def test_hazards_of_another_kind_end_in_the_fallback(monitors, at_rest, bad) -> None:
    decision = monitors["always"].decide(at_rest, bad)
    assert decision.mode == "fallback"
    assert decision.reason


@pytest.mark.parametrize("bad", ["left", {}, FilterMemory.empty(0), FilterMemory.empty(2)])
def test_a_memory_of_another_robot_or_kind_is_a_fault_and_not_handed_back(monitors, at_rest, bad) -> None:
    decision = monitors["always"].decide(at_rest, memory=bad)
    assert decision.mode == "fallback"
    assert decision.memory is not None
    assert decision.memory.side.tolist() == [0]
    assert "memory" in str(decision.reason)
    with pytest.raises(ValueError, match="memory"):
        monitors["always"].decide_batch(np.tile(at_rest, (3, 1)), memory=bad)


def test_hazards_of_another_number_of_robots_are_refused(monitors, at_rest) -> None:
    for bad in (1.0, np.ones((4, 2)), np.ones((1, 4, 2)), np.ones((2, 4, 3))):
        with pytest.raises(ValueError, match="hazards"):
            monitors["always"].decide_batch(np.tile(at_rest, (2, 1)), bad)


def test_the_filter_takes_the_bundles_hazard_radius(own_bundle: Path, at_rest) -> None:
    before = Monitor.load(own_bundle, "always").decide(at_rest, [[0.5, 0.0]]).barrier
    bundle = Bundle.load(own_bundle)
    wider = bundle.manifest.model_copy(update={"hazard_radius": bundle.manifest.hazard_radius + 0.1})
    write_bundle(own_bundle, bundle.policy, bundle.multiplier, wider)
    after = Monitor.load(own_bundle, "always").decide(at_rest, [[0.5, 0.0]]).barrier
    assert after == pytest.approx(before - 0.1)


def test_a_fault_forgets_what_the_filter_planned(monitors, at_rest) -> None:
    memory = FilterMemory.empty(1)
    memory.side[:] = 1
    at_rest[0] = np.nan
    after = monitors["always"].decide(at_rest, memory=memory).memory
    assert after is not None
    assert after.side.tolist() == [0]


def test_no_hazards_given_means_none_are_there(monitors, at_rest) -> None:
    at_rest[28] = 0.95  # the lidar sees one, which the given list overrules
    assert monitors["always"].decide(at_rest, []).mode == "nominal"


def test_one_bad_row_falls_back_alone(monitors, at_rest) -> None:
    rows = np.tile(at_rest, (4, 1))
    rows[2, 5] = np.nan
    batch = monitors["always"].decide_batch(rows, memory=FilterMemory.empty(4))
    assert batch.mode.tolist() == [Mode.NOMINAL, Mode.NOMINAL, Mode.FALLBACK, Mode.NOMINAL]
    assert batch[2].reason == "observation[5] is nan"
    assert same_bits(batch[0].action, monitors["always"].decide(at_rest).action)
    assert batch.memory is not None
    assert len(batch.memory.side) == 4


def test_a_batch_of_none_and_one_of_another_rank(monitors, at_rest) -> None:
    assert len(monitors["always"].decide_batch(np.zeros((0, 60)))) == 0
    with pytest.raises(ValueError, match=r"\[N, 60\]"):
        monitors["always"].decide_batch(at_rest)
    assert (monitors["off"].decide_batch(np.zeros((3, 59))).mode == Mode.FALLBACK).all()


@pytest.mark.parametrize(
    ("settings_", "named"),
    [
        ({"gate": "sometimes"}, "gate must be one of risk, always, off"),
        ({"threshold": float("nan")}, "threshold"),
        ({"threshold": -1.0}, "threshold"),
        ({"threshold": float("inf")}, "threshold"),
    ],
)
def test_settings_that_make_no_monitor_are_refused(tiny_bundle: Path, settings_, named) -> None:
    with pytest.raises(MonitorError, match=named):
        Monitor.load(tiny_bundle, **settings_)


def test_a_bundle_of_another_observation_layout_is_refused(own_bundle: Path) -> None:
    bundle = Bundle.load(own_bundle)
    blocks = [block.model_dump() for block in bundle.manifest.observation_layout]
    blocks[0]["name"], blocks[1]["name"] = blocks[1]["name"], blocks[0]["name"]
    fields = bundle.manifest.model_dump() | {"observation_layout": blocks}
    write_bundle(own_bundle, bundle.policy, bundle.multiplier, type(bundle.manifest).model_validate(fields))
    with pytest.raises(MonitorError, match="observation layout"):
        Monitor.load(own_bundle)


def test_networks_that_give_nan_at_rest_are_refused_at_load(make_bundle_of, tmp_path: Path) -> None:
    path = make_bundle_of(tmp_path / "nan", multiplier_tail=["Neg", "Sqrt"])
    with pytest.raises(MonitorError, match="robot at rest: the networks gave"):
        Monitor.load(path)


def test_a_graph_that_onnxruntime_refuses_is_named(make_bundle_of, tmp_path: Path) -> None:
    path = make_bundle_of(tmp_path / "odd", multiplier_tail=["Not"])  # of a float: onnx checks no types
    with pytest.raises(MonitorError, match=r"multiplier\.onnx: onnxruntime refuses it"):
        Monitor.load(path)


def test_a_level_0_bundle_decides(make_bundle_of, tmp_path: Path) -> None:
    monitor = Monitor.load(make_bundle_of(tmp_path / "level0", level=0), "always")
    assert monitor.decide(np.zeros(28)).mode == "nominal"
    assert monitor.decide(np.zeros(60)).mode == "fallback"
