"""The gate: early by the risk score, at the latest by the barrier; closed, it forgets nothing."""

from __future__ import annotations

import numpy as np
import pytest

from decision import MEMORY, MOST_OPEN, Mode, OpenedBy
from monitor import GATES, Gate, Monitor, MonitorError
from pointgoal.observation import HAZARD_RADIUS


def test_what_opens_it() -> None:
    risk = np.array([0.4, 0.5, np.nextafter(0.5, 1.0), np.nan, np.inf, 0.4, 0.9])
    low = np.array([False, False, False, False, False, True, True])
    fresh = np.zeros(7, MEMORY)
    opened = Gate("risk", 0.5).opened_by(risk, low, fresh)
    assert opened.tolist() == ["", "", "risk", "risk", "risk", "barrier", "risk"]
    held = np.zeros(7, MEMORY)
    held["open"] = [1, 0, 1, 0, 0, 1, 1]
    opened = Gate("risk", 0.5).opened_by(risk, low, held)
    assert opened.tolist() == ["dwell", "", "risk", "risk", "risk", "dwell", "risk"]
    assert Gate("always", 0.5).opened_by(risk, low, fresh).tolist() == ["always"] * 7
    assert Gate("off", 0.5).opened_by(risk, low, held).tolist() == [""] * 7
    assert GATES == ("risk", "always", "off")
    # Every reason fits, whatever the first rows say.
    for gate in GATES:
        assert Gate(gate, 0.5).opened_by(risk, low, fresh).dtype.itemsize // 4 >= max(map(len, OpenedBy))


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (("sometimes", 0.5), "gate"),
        *((("risk", threshold), "threshold") for threshold in (np.nan, -0.1, np.inf)),
        (("off", np.nan), "threshold"),
        *((("risk", 0.5, hysteresis), "hysteresis") for hysteresis in (0.0, 1.01, -0.5, np.nan)),
        *((("risk", 0.5, 0.5, dwell), "dwell") for dwell in (-1, MOST_OPEN + 1)),
    ],
)
def test_what_is_no_gate_is_refused(settings, named) -> None:
    with pytest.raises(MonitorError, match=named):
        Gate(*settings)


@pytest.mark.parametrize("threshold", [0.5, 0.0, 0.9])
def test_a_threshold_beside_a_whole_gate_is_refused(tiny_bundle, threshold) -> None:
    """It would be ignored, even where it is the gate's own; a gate's name takes it."""
    gate = Gate("risk", 0.5, dwell=3)
    with pytest.raises(MonitorError, match="threshold must be None beside a Gate"):
        Monitor.load(tiny_bundle, gate=gate, threshold=threshold)
    assert Monitor.load(tiny_bundle, gate=gate).gate == gate
    assert Monitor.load(tiny_bundle, gate="risk", threshold=threshold).gate.threshold == threshold


def opened(gate: Gate, risks: list[float], low: list[bool], changed: list[bool]) -> list[str]:
    """What opens a gate, step after step, for one robot that starts without a memory."""
    memory, causes = np.zeros(1, MEMORY), []
    for now in zip(risks, low, changed, strict=True):
        risk, is_low, is_changed = (np.array([value]) for value in now)
        causes.append(str(gate.opened_by(risk, is_low, memory)[0]))
        gate.remember(risk, is_low, is_changed & (causes[-1] != ""), memory)
    return causes


NO = [False] * 8


def test_it_closes_after_its_dwell() -> None:
    gate = Gate("risk", 0.5, dwell=3)
    risks = [0.1, 0.6, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]
    assert opened(gate, risks, NO, NO) == ["", "risk", "dwell", "dwell", "dwell", "", "", ""]
    # And memoryless without one, as bundles are that state none.
    assert opened(Gate("risk", 0.5), risks, NO, NO) == ["", "risk", *[""] * 6]


def test_hysteresis_keeps_it_open_and_never_opens_it() -> None:
    gate = Gate("risk", 0.5, hysteresis=0.6, dwell=2)
    assert opened(gate, [0.4] * 8, NO, NO) == [""] * 8
    risks = [0.6, 0.4, 0.31, 0.4, 0.3, 0.1, 0.4, 0.4]
    assert opened(gate, risks, NO, NO) == ["risk", *["dwell"] * 5, "", ""]


def test_it_does_not_close_while_the_filter_has_the_robot_in_hand() -> None:
    gate = Gate("risk", 0.5, dwell=1)
    risks, changed = [0.6, *[0.0] * 7], [True, True, True, True, False, False, False, False]
    assert opened(gate, risks, NO, changed) == ["risk", *["dwell"] * 4, "", "", ""]


def test_a_barrier_that_opened_it_keeps_it_open_for_the_dwell() -> None:
    gate = Gate("risk", 0.5, dwell=2)
    low = [False, True, True, False, False, False, False, False]
    assert opened(gate, [0.0] * 8, low, NO) == ["", "barrier", "dwell", "dwell", "dwell", "", "", ""]


def test_a_risk_that_is_no_number_keeps_it_open() -> None:
    assert opened(Gate("risk", 0.5, dwell=1), [np.nan, 0.0, np.nan, *[0.0] * 5], NO, NO) == [
        *("risk", "dwell", "risk", "dwell"),
        *[""] * 4,
    ]


def test_the_monitor_remembers_it_for_each_robot(build, at_rest) -> None:
    """Two robots, of which one had a high score; without their memory neither knows."""
    networks = build.networks([[0.02, 0.2]], [0.0])
    monitor = build(networks, gate="risk", threshold=0.5, hysteresis=0.5, dwell=4)
    networks.risk = [0.9, 0.1]
    seen = np.array([at_rest, at_rest])
    first = monitor.decide_batch(seen)
    assert first.opened_by.tolist() == ["risk", ""]
    assert first.memory["open"].tolist() == [4, 0]
    networks.risk = [0.0]
    second = monitor.decide_batch(seen, memory=first.memory)
    assert second.opened_by.tolist() == ["dwell", ""]
    assert second.memory["open"].tolist() == [3, 0]
    assert monitor.decide_batch(seen).opened_by.tolist() == ["", ""]
    alone = monitor.decide(at_rest, memory=first.memory[0])
    assert (alone.opened_by, alone.memory["open"]) == (OpenedBy.DWELL, 3)


def test_the_gate_opens_above_the_threshold_and_not_at_it(build, at_rest) -> None:
    for risk, opens in ((0.5, False), (np.nextafter(0.5, 1.0), True), (0.0, False), (1e30, True)):
        monitor = build(build.networks([[0.1, 0.2]], [risk]), gate="risk", threshold=0.5)
        decision = monitor.decide(at_rest)
        assert decision.gate_open is opens
        assert decision.opened_by == (OpenedBy.RISK if opens else None)


def test_a_risk_that_is_no_number_is_a_fault(build, at_rest) -> None:
    decision = build(build.networks([[0.1, 0.2]], [np.nan]), gate="risk").decide(at_rest)
    assert decision.opened_by == OpenedBy.FAULT
    assert decision.mode == Mode.FALLBACK


def test_the_floor_opens_it_whatever_the_risk_says(build, hand) -> None:
    ahead = np.array([[0.4, 0.0]])
    monitor = build(build.networks([[1.0, 0.0]], [0.0]), gate="risk", threshold=1e9)
    near, far = (monitor.decide(hand.observe(ahead, (v, 0.0)), ahead) for v in (1.2, 0.1))
    assert near.opened_by == OpenedBy.BARRIER
    assert near.mode != Mode.NOMINAL
    assert far.opened_by is None
    assert far.mode == Mode.NOMINAL
    assert far.barrier > near.barrier >= 0.0


@pytest.mark.parametrize("source", ["given", "lidar"])
def test_off_never_changes_an_action(build, hand, drive, source) -> None:
    networks = build.networks(None)
    monitor = build(networks, gate="off")
    memory, entered = None, 0
    for now in drive(200):
        networks.action = hand.attacker(now.observation, now.hazards, None)
        decided = monitor.decide_batch(now.observation, now.hazards if source == "given" else None, memory)
        assert decided.action.tobytes() == networks.action.tobytes()
        assert (decided.mode == Mode.NOMINAL).all()
        assert not decided.gate_open.any()
        assert not decided.certified.any()
        entered += int((now.cost > 0.0).sum())
        memory, now.action = decided.memory, decided.action
    assert entered > 100


def test_closed_it_remembers_the_side_and_leaves_the_sure_backup(build, hand) -> None:
    ahead = np.array([[0.8, 0.02]])
    observation = hand.observe(ahead, (1.0, 0.0))
    memory = np.zeros(1, MEMORY)
    memory["side"] = -30
    decision = build(build.networks([[1.0, 0.0]], [0.0]), gate="risk").decide(observation, ahead, memory)
    assert not decision.gate_open
    assert decision.memory["side"] == -29
    # Coasting would end 0.52 m ahead, past nothing: that is a plan. From faster it has to brake.
    fast = build(build.networks([[1.0, 0.0]], [0.0]), gate="risk").decide(
        hand.observe(ahead, (1.4, 0.0)), ahead, memory
    )
    assert not fast.gate_open
    assert len(fast.plan) > 0
    state = np.array([[0.0, 0.0, 0.0, 1.4, 0.0, 0.0]])
    least = hand.least_distance_of_the_plan(state, fast.action[None], np.array([fast.memory]), ahead[None])
    assert least[0] > HAZARD_RADIUS
    coasting = hand.least_distance_of_the_plan(state, fast.action[None], np.zeros(1, MEMORY), ahead[None])
    assert coasting[0] < HAZARD_RADIUS


def check_never_opened_by_risk(build, hand, drive, source, policy, steps) -> None:
    networks, rng = build.networks(None, [0.0]), np.random.default_rng(3)
    monitor = build(networks, gate="risk", threshold=1e9)
    memory, counts = np.zeros(40, MEMORY), dict.fromkeys(("barrier", ""), 0)
    for now in drive(steps, seed=21):
        assert (now.cost == 0.0).all(), (now.step, np.flatnonzero(now.cost > 0.0))
        networks.action = getattr(hand, policy)(now.observation, now.hazards, rng)
        seen, known = now.observation, now.hazards
        if source in ("lidar", "empty"):
            known = None if source == "lidar" else np.empty((40, 0, 2))
        elif source == "blank":
            seen = seen.copy()
            seen[:, 28:44] = 0.0
        elif source == "lacking":  # the nearest is not in the list
            known = known.copy()
            known[np.arange(40), np.linalg.norm(known, axis=2).argmin(axis=1)] = np.nan
        decided = monitor.decide_batch(seen, known, memory)
        assert not (decided.opened_by == "risk").any()
        assert not (decided.opened_by == "fault").any()
        for name in counts:
            counts[name] += int((decided.opened_by == name).sum())
        memory, now.action = decided.memory, decided.action
    assert min(counts.values()) > 10
    assert monitor.faults.counts.total() == 0


POLICIES = ["attacker", "random", "full_thrust"]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("source", ["given", "lidar"])
def test_with_a_risk_that_never_opens_the_floor_alone_keeps_everybody_out(
    build, hand, drive, source, policy
) -> None:
    check_never_opened_by_risk(build, hand, drive, source, policy, 500)


@pytest.mark.parametrize("source", ["blank", "empty", "lacking"])
def test_and_whichever_of_list_and_lidar_is_missing(build, hand, drive, source) -> None:
    check_never_opened_by_risk(build, hand, drive, source, "attacker", 500)


@pytest.mark.long
@pytest.mark.parametrize("policy", [*POLICIES, "seeker"])
@pytest.mark.parametrize("source", ["given", "lidar", "blank", "empty", "lacking"])
def test_for_whole_episodes(build, hand, drive, source, policy) -> None:
    check_never_opened_by_risk(build, hand, drive, source, policy, 999)
