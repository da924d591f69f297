"""The gate: early by the risk score, at the latest by the barrier; closed, it forgets nothing."""

from __future__ import annotations

import numpy as np
import pytest

from decision import MEMORY, Mode, OpenedBy
from monitor import GATES, Gate, MonitorError
from pointgoal.observation import HAZARD_RADIUS


def test_what_opens_it() -> None:
    risk = np.array([0.4, 0.5, np.nextafter(0.5, 1.0), np.nan, np.inf, 0.4, 0.9])
    low = np.array([False, False, False, False, False, True, True])
    opened = Gate("risk", 0.5).opened_by(risk, low)
    assert opened.tolist() == ["", "", "risk", "risk", "risk", "barrier", "risk"]
    assert Gate("always", 0.5).opened_by(risk, low).tolist() == ["always"] * 7
    assert Gate("off", 0.5).opened_by(risk, low).tolist() == [""] * 7
    assert GATES == ("risk", "always", "off")
    # Every reason fits, whatever the first rows say.
    for gate in GATES:
        assert Gate(gate, 0.5).opened_by(risk, low).dtype.itemsize // 4 >= max(map(len, OpenedBy))


@pytest.mark.parametrize(
    ("name", "threshold"),
    [("sometimes", 0.5), ("risk", np.nan), ("risk", -0.1), ("risk", np.inf), ("off", np.nan)],
)
def test_what_is_no_gate_is_refused(name, threshold) -> None:
    with pytest.raises(MonitorError, match="gate" if name == "sometimes" else "threshold"):
        Gate(name, threshold)


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
