"""One observation in, one decision out: what holds always, and what happens when a part fails."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from decision import MEMORY, SAFE_ACTION, Mode, OpenedBy, Origin
from filter import FilterConfig, FilterError, FilterInputError, Robot
from models import Bundle, write_bundle
from monitor import Monitor, MonitorError, NetworkError
from pointgoal.lidar import encode

READINGS = st.floats(0.0, 1.0)
MOTION = st.floats(-3.0, 3.0)


@st.composite
def observations(draw: st.DrawFn) -> np.ndarray:
    """Observations [60]: motion of a few metres a second, readings in [0, 1], mostly scans of hazards."""
    made = np.concatenate(
        [draw(arrays(np.float64, 12, elements=MOTION)), draw(arrays(np.float64, 48, elements=READINGS))]
    )
    if draw(st.integers(0, 9)):
        made[28:44] = encode(draw(arrays(np.float64, (1, 4, 2), elements=st.floats(-3.0, 3.0))))[0]
    return made


HAZARDS = st.none() | st.integers(0, 10).flatmap(
    lambda n: arrays(np.float64, (n, 2), elements=st.floats(-4.0, 4.0))
)


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.tobytes() == b.tobytes()


def written(bundle: Bundle, **changes: object) -> None:
    """Writes a bundle anew with another manifest."""
    fields = bundle.manifest.model_dump() | changes
    write_bundle(bundle.path, bundle.policy, bundle.multiplier, type(bundle.manifest).model_validate(fields))


@settings(max_examples=60, deadline=None)
@given(observation=observations(), hazards=HAZARDS, gate=st.sampled_from(["risk", "always", "off"]))
def test_what_holds_of_every_decision(monitors, observation, hazards, gate) -> None:
    decision = monitors[gate].decide(observation, hazards)
    assert np.isfinite(decision.action).all()
    assert (np.abs(decision.action) <= 1.0).all()
    assert decision.risk >= 0.0
    if gate == "risk":
        opened = decision.opened_by
        if np.isnan(decision.barrier):
            assert opened == OpenedBy.FAULT
        else:
            assert (opened == OpenedBy.RISK) == (decision.risk > decision.threshold)
            assert opened in (None, OpenedBy.RISK, OpenedBy.BARRIER)
    elif gate == "always":
        assert decision.opened_by == (OpenedBy.FAULT if np.isnan(decision.barrier) else OpenedBy.ALWAYS)
    else:
        assert decision.opened_by is None
    assert decision.gate_open == (decision.opened_by is not None)
    assert (decision.origin is None) == (decision.mode == "nominal")
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
        np.testing.assert_equal(alone.barrier, together.barrier)  # a NaN is equal to a NaN
        for name in ("mode", "origin", "hazard", "certified", "reason", "opened_by", "memory"):
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
    assert decision.origin is not None
    assert not decision.certified


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
        AttributeError("broken"),
        TypeError("broken"),
        AssertionError("broken"),
        RuntimeError("broken"),
        ValueError("broken"),
        ZeroDivisionError("broken"),
        MemoryError("broken"),
        KeyError("broken"),
        np.linalg.LinAlgError("broken"),
    ],
)
@pytest.mark.parametrize("where", ["look", "decide"])
def test_a_filter_that_raises_ends_in_the_fallback(build, at_rest, gate, fault, where) -> None:
    decision = build(action_filter=build.filter(fault, where), gate=gate).decide(at_rest)
    assert decision.mode == "fallback"
    assert "broken" in str(decision.reason)
    assert tuple(decision.action) == SAFE_ACTION


@pytest.mark.parametrize(
    ("gate", "changes"),
    [
        ("always", {"action": np.array([[np.nan, 0.0]]), "mode": np.array(["filtered"])}),
        ("always", {"action": np.array([[0.0, 1.5]]), "mode": np.array(["filtered"])}),
        ("always", {"action": np.zeros((1, 3))}),
        ("always", {"action": np.zeros((2, 2))}),
        ("always", {"action": np.array([[0.01, 0.02]]), "mode": np.array(["nominal"])}),
        ("off", {"action": np.array([[0.01, 0.02]]), "mode": np.array(["filtered"])}),
        ("off", {"action": np.array([[np.nan, 0.02]]), "mode": np.array(["filtered"])}),
        ("always", {"mode": np.array(["nominal", "nominal"])}),
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


@pytest.mark.parametrize("bad", ["left", {}, 3, np.zeros(0, MEMORY), np.zeros(2, MEMORY), np.zeros(1)])
def test_a_memory_of_another_robot_or_kind_is_a_fault_and_not_handed_back(monitors, at_rest, bad) -> None:
    decision = monitors["always"].decide(at_rest, memory=bad)
    assert decision.mode == "fallback"
    assert decision.memory.dtype == MEMORY
    assert decision.action.tolist() == [0.0, 0.0]
    assert "memory" in str(decision.reason)
    with pytest.raises(ValueError, match="memory"):
        monitors["always"].decide_batch(np.tile(at_rest, (3, 1)), memory=bad)


@pytest.mark.parametrize(
    ("left", "plan"),
    [(3, np.nan), (3, np.inf), (3, 1.5), (21, 0.05), (127, 0.05), (-1, 0.05)],
)
@pytest.mark.parametrize("fault", ["none", "observation", "networks"])
def test_a_memory_that_no_filter_wrote_sends_nothing_wild(build, at_rest, left, plan, fault) -> None:
    memory = np.zeros(1, MEMORY)
    memory["left"], memory["plan"] = left, plan
    if fault == "observation":
        at_rest[0] = np.nan
    networks = build.networks([[np.nan, 0.0]] if fault == "networks" else [[0.1, 0.1]])
    monitor = build(networks)
    for _ in range(3):
        decision = monitor.decide(at_rest, memory=memory)
        assert np.isfinite(decision.action).all()
        assert (np.abs(decision.action) <= 1.0).all()
        assert 0 <= decision.memory["left"] <= 20
        memory = decision.memory


def test_the_memory_of_a_decision_is_taken_as_it_is_given(build, hand) -> None:
    # A row of an array, or an array of one: both are one robot's memory.
    near = np.array([[0.305, 0.03]])
    monitor = build(build.networks([[1.0, 0.0]]))
    observation = hand.observe(near, (0.8, 0.0), 0.0, (2.0, 0.0))
    memory = monitor.decide(observation, near).memory
    memory["side"] = -30
    after = [monitor.decide(observation, near, form) for form in (memory, np.array([memory]))]
    assert after[0].memory.tobytes() == after[1].memory.tobytes()


def test_hazards_of_another_number_of_robots_are_refused(monitors, at_rest) -> None:
    for bad in (1.0, np.ones((4, 2)), np.ones((1, 4, 2)), np.ones((2, 4, 3))):
        with pytest.raises(ValueError, match="hazards"):
            monitors["always"].decide_batch(np.tile(at_rest, (2, 1)), bad)


def test_the_filter_takes_the_bundles_hazard_radius(own_bundle: Path, at_rest) -> None:
    before = Monitor.load(own_bundle, "always").decide(at_rest, [[0.5, 0.0]]).barrier
    bundle = Bundle.load(own_bundle)
    radius = bundle.manifest.hazard_radius
    written(bundle, hazard_radius=radius + 0.1)

    def barrier(config: FilterConfig | None) -> float:
        return Monitor.load(own_bundle, "always", filter_config=config).decide(at_rest, [[0.5, 0.0]]).barrier

    assert barrier(None) == pytest.approx(before - 0.1)
    # Settings about something else do not drop it.
    assert barrier(FilterConfig()) == pytest.approx(before - 0.1)
    assert barrier(FilterConfig(margin=0.03)) == pytest.approx(before - 0.12)
    assert barrier(FilterConfig(hazard_radius=radius + 0.1)) == pytest.approx(before - 0.1)
    assert barrier(FilterConfig(hazard_radius=radius + 0.15)) == pytest.approx(before - 0.15)
    with pytest.raises(MonitorError, match="hazard_radius must be at least the bundle's"):
        barrier(FilterConfig(hazard_radius=radius))


def test_the_manifests_robot_reaches_the_filter(own_bundle: Path, hand) -> None:
    # A robot of twice the mass coasts twice as far.
    ahead = np.array([[0.9, 0.0]])
    observation = hand.observe(ahead, (1.2, 0.0))
    before = Monitor.load(own_bundle, "always").decide(observation, ahead)
    bundle = Bundle.load(own_bundle)
    written(bundle, robot={"mass": 2 * Robot().mass, "inertia": 2 * Robot().inertia})
    heavy = Monitor.load(own_bundle, "always").decide(observation, ahead)
    # Braking from 1.2 m/s takes twice the way.
    assert heavy.barrier < before.barrier - 0.1
    settled = Monitor.load(own_bundle, "always", filter_config=FilterConfig(robot=Robot()))
    assert settled.decide(observation, ahead).barrier == pytest.approx(before.barrier)
    # It reaches the guide as well, whose robot is the filter's.
    monitor = Monitor.load(own_bundle, "always")
    assert monitor._filter.guide._settings["robot"]["mass"][0] == pytest.approx(2 * Robot().mass)


def test_a_robot_with_a_constant_that_is_none_is_refused(own_bundle: Path) -> None:
    written(Bundle.load(own_bundle), robot={"mass": 0.005, "wheels": 4})
    with pytest.raises(MonitorError, match="wheels"):
        Monitor.load(own_bundle)


def test_the_guides_strength_is_chosen_at_load(tiny_bundle: Path, hand) -> None:
    at, goal = np.array([[0.6, 0.02]]), (2.2, 0.0)
    observation, memory = hand.observe(at, (0.3, 0.0), 0.0, goal), np.zeros(1, MEMORY)
    memory["guided"] = 1
    modes = {
        strength: Monitor.load(tiny_bundle, "always", guide=strength).decide(observation, at, memory).mode
        for strength in ("off", "refusal", "ahead")
    }
    assert modes == {"off": "nominal", "refusal": "guided", "ahead": "guided"}
    assert Monitor.load(tiny_bundle).decide_batch(observation[None], at[None], memory).mode[0] != "filtered"
    with pytest.raises(MonitorError, match="guide must be one of"):
        Monitor.load(tiny_bundle, guide="boldly")


def test_a_fault_goes_on_with_the_plan_and_keeps_the_side(monitors, at_rest) -> None:
    memory = np.zeros(1, MEMORY)
    memory["side"], memory["guided"], memory["left"] = 9, 1, 2
    memory["plan"][0, :2] = [(-0.05, 0.3), (-0.05, 0.0)]
    at_rest[0] = np.nan
    for expected in ([-0.05, 0.3], [-0.05, 0.0], [0.0, 0.0], [0.0, 0.0]):
        decision = monitors["always"].decide(at_rest, memory=memory)
        assert decision.action.tolist() == expected
        assert (decision.mode, decision.origin) == (Mode.FALLBACK, Origin.PLAN)
        assert decision.opened_by == OpenedBy.FAULT
        assert not decision.certified
        assert np.isnan(decision.nominal_action).all()
        assert np.isnan([decision.barrier, decision.risk]).all()
        memory = decision.memory
    assert memory["side"] == 9


@pytest.mark.parametrize("gate", ["always", "risk"])
def test_an_empty_list_of_hazards_overrules_no_sensor(build, hand, gate) -> None:
    ahead = np.array([[0.4, 0.0]])
    monitor = build(build.networks([[1.0, 0.0]]), gate=gate, threshold=1e9)
    for known in ([], None, np.empty((0, 2)), [[0.0, 1.0]]):
        decision = monitor.decide(hand.observe(np.vstack([ahead, [[0.0, 1.0]]]), (1.2, 0.0)), known)
        assert decision.mode != "nominal"
        assert decision.gate_open


@pytest.mark.parametrize("bad", [[[np.nan, np.nan]], [[None, None]], [[0.4, 0.0], [np.nan, np.nan]]])
def test_one_robots_hazards_that_are_no_numbers_are_refused(monitors, at_rest, bad) -> None:
    # In a batch they stand for none; one robot's list is as long as it has hazards.
    for monitor in monitors.values():
        decision = monitor.decide(at_rest, bad)
        assert decision.mode == "fallback"
        assert "hazards must be finite" in str(decision.reason)


def test_in_a_batch_a_row_of_nan_is_no_hazard(monitors, at_rest) -> None:
    hazards = np.full((2, 2, 2), np.nan)
    hazards[0, 0] = (0.5, 0.0)
    batch = monitors["always"].decide_batch(np.tile(at_rest, (2, 1)), hazards)
    assert batch.mode.tolist() == ["nominal", "nominal"]
    assert batch.barrier[0] < batch.barrier[1] == 3.0


@pytest.mark.parametrize(
    ("action", "sound"),
    [([1.0 + 5e-7, 0.0], True), ([1.0 + 2e-6, 0.0], False), ([0.0, -1.5], False), ([np.inf, 0.0], False)],
)
def test_a_nominal_action_beyond_its_bounds_is_a_fault_and_never_clipped_in_silence(
    build, at_rest, action, sound
) -> None:
    for gate in ("always", "off", "risk"):
        monitor = build(build.networks([action]), gate=gate)
        decision = monitor.decide(at_rest)
        assert (decision.mode == "nominal") == sound
        assert (monitor.faults.counts["networks"] == 0) == sound
        if not sound:
            assert decision.opened_by == OpenedBy.FAULT
            np.testing.assert_array_equal(decision.nominal_action, action)


def test_bounds_of_the_manifest_that_are_tighter_hold(own_bundle: Path, build, at_rest) -> None:
    written(Bundle.load(own_bundle), action_low=[-0.5, -0.5], action_high=[0.5, 0.5])
    bundle = Bundle.load(own_bundle)
    monitor = Monitor(bundle, build.networks([[0.7, 0.0]]), build.filter(), "off")
    assert monitor.decide(at_rest).mode == "fallback"


def test_one_bad_row_falls_back_alone(monitors, at_rest) -> None:
    rows = np.tile(at_rest, (4, 1))
    rows[2, 5] = np.nan
    batch = monitors["always"].decide_batch(rows, memory=np.zeros(4, MEMORY))
    assert batch.mode.tolist() == [Mode.NOMINAL, Mode.NOMINAL, Mode.FALLBACK, Mode.NOMINAL]
    assert "observation[5]" in str(batch[2].reason)
    assert batch.opened_by.tolist() == ["always", "always", "fault", "always"]
    assert same_bits(batch[0].action, monitors["always"].decide(at_rest).action)
    assert batch.memory.shape == (4,)


@pytest.mark.parametrize("where", ["look", "decide", "networks"])
@pytest.mark.parametrize("spoilt", [[1], [0, 3], [0, 1, 2, 3, 4]])
def test_a_fault_in_some_rows_leaves_the_others_alone(build, hand, where, spoilt) -> None:
    near = np.array([[0.305, 0.03]])
    rows = np.tile(hand.observe(near, (0.8, 0.0)), (5, 1))
    rows[:, 5] = np.arange(5) * 1e-3
    memory = np.zeros(5, MEMORY)
    memory["left"], memory["plan"][:, 0] = 1, (-0.03, 0.1)
    networks, broken = build.networks([[1.0, 0.0]]), build.filter(AttributeError("broken"), where)
    broken.spoilt = 0.79
    sound = build(networks, build.filter()).decide_batch(rows, None, memory)
    if where == "networks":

        def failing(observation):
            if (observation[:, 3] == 0.79).any():
                raise AttributeError("broken")
            return [[1.0, 0.0]]

        networks, broken = build.networks(failing), build.filter()
    rows[spoilt, 3] = 0.79
    monitor = build(networks, broken)
    batch = monitor.decide_batch(rows, None, memory)
    for k in range(5):
        if k in spoilt:
            assert batch[k].reason == "broken"
            assert batch.action[k].tolist() == [-0.03, 0.1]
            assert batch[k].opened_by == OpenedBy.FAULT
        else:
            assert batch[k].origin == sound[k].origin
            assert sound[k].mode == Mode.FILTERED
            assert same_bits(batch.action[k], sound.action[k])
            assert batch.memory[k].tobytes() == sound.memory[k].tobytes()
    assert monitor.faults.counts["AttributeError"] == len(spoilt)
    assert monitor.faults.internal() == len(spoilt)


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


@pytest.mark.parametrize("gate", ["always", "risk"])
def test_a_scan_that_contradicts_itself_opens_the_gate_and_is_counted(build, hand, gate) -> None:
    networks = build.networks(action=[(1.0, 0.0)], risk=[0.0])
    monitor = build(networks, gate=gate, threshold=1.0)
    observation = hand.observe(np.array([[0.45, 0.05]]), (1.0, 0.0))
    before = monitor.decide(observation)
    dead = observation.copy()
    dead[28] = 0.0
    decision = monitor.decide(dead, memory=before.memory)
    assert (decision.mode, decision.opened_by) == (Mode.FALLBACK, OpenedBy.FAULT)
    np.testing.assert_array_equal(decision.action, before.plan[0])
    assert np.isnan(decision.barrier)
    assert "lidar" in decision.reason
    assert monitor.faults.counts["lidar"] == 1
    # The networks' fault beside it takes nothing more of the plan.
    networks.action = [(np.nan, 0.0)]
    both = monitor.decide(dead, memory=before.memory)
    np.testing.assert_array_equal(both.action, decision.action)
    np.testing.assert_array_equal(both.memory, decision.memory)
    # With the gate off, nothing but the policy decides.
    networks.action = [(1.0, 0.0)]
    assert build(networks, gate="off").decide(dead).mode == Mode.NOMINAL


@pytest.mark.parametrize("way", ["copy", "deepcopy", "pickle"])
@pytest.mark.parametrize("solver", ["planar", "osqp"])
def test_a_copy_decides_alike_and_keeps_its_count(tiny_bundle, hand, way, solver) -> None:
    monitor = Monitor.load(tiny_bundle, "always", filter_config=FilterConfig(solver=solver))
    monitor.decide([1.0])
    counts = dict(monitor.faults.counts)
    other = pickle.loads(pickle.dumps(monitor)) if way == "pickle" else getattr(copy, way)(monitor)
    assert other.faults.counts == counts
    assert counts == {"bad input": 1}
    modes = set()
    for speed in np.arange(0.9, 1.4, 0.02):
        observation = hand.observe(np.array([[0.4, 0.02]]), (speed, 0.0))
        mine, theirs = monitor.decide(observation), other.decide(observation)
        # OSQP starts from what it solved last.
        np.testing.assert_allclose(
            mine.action, theirs.action, rtol=0.0, atol=0.0 if solver == "planar" else 1e-6
        )
        assert (mine.origin, mine.risk, mine.barrier) == (theirs.origin, theirs.risk, theirs.barrier)
        modes.add(mine.mode)
    assert {Mode.NOMINAL, Mode.FALLBACK} <= modes
    other.decide([1.0])
    assert other.faults.counts["bad input"] == 2


def test_any_row_of_a_batch_can_be_gone_on_from(build, hand) -> None:
    """Also one that is counted from the end."""
    monitor = build(build.networks([[1.0, 0.0]], [0.0]))
    near = np.array([[0.45, 0.05]])
    seen = np.array([hand.observe(near, (v, 0.0)) for v in (0.2, 0.6, 1.0)])
    batch = monitor.decide_batch(seen)
    for k in (-1, -2, -3, 0, 1, 2):
        alone = monitor.decide(seen[k])
        assert alone.memory["planned"]
        assert batch[k].memory.tobytes() == alone.memory.tobytes()
        assert same_bits(batch[k].action, alone.action)
    assert len(batch[-1].plan) > 0
