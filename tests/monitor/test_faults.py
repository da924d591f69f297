"""What goes wrong is survived at speed, counted, and logged once a kind a minute."""

from __future__ import annotations

import logging
import subprocess
import sys

import numpy as np
import pytest

from decision import MEMORY, Mode, OpenedBy, Origin, next_of_plan
from pointgoal.observation import HAZARD_RADIUS

LOGGER = "lagnet.monitor"


def test_what_the_caller_did_wrong_is_no_internal_fault(build, at_rest, caplog) -> None:
    monitor = build()
    with caplog.at_level(logging.WARNING, LOGGER):
        for _ in range(3):
            monitor.decide([1.0, 2.0])
            monitor.decide(at_rest, [[np.inf, 0.0]])
            monitor.decide(at_rest, memory="left")
            monitor.decide(np.full(60, np.nan))
    assert monitor.faults.counts == {"bad input": 12}
    assert monitor.faults.internal() == 0
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    "error", [AttributeError("'NoneType' object has no attribute 'run'"), TypeError("x")]
)
def test_a_programming_error_is_an_internal_fault_with_its_traceback(build, at_rest, caplog, error) -> None:
    def failing(observation):
        raise error

    monitor = build(build.networks(failing))
    with caplog.at_level(logging.WARNING, LOGGER):
        decision = monitor.decide(at_rest)
    assert decision.mode == Mode.FALLBACK
    assert decision.opened_by == OpenedBy.FAULT
    assert decision.reason == str(error)
    assert monitor.faults.counts == {type(error).__name__: 1}
    assert monitor.faults.internal() == 1
    assert caplog.records[0].exc_info[1] is error


def test_a_message_without_words_is_named_by_its_kind(build, at_rest) -> None:
    assert build(action_filter=build.filter(ValueError())).decide(at_rest).reason == "ValueError"


def test_networks_that_give_no_number_are_counted_by_row(build, at_rest) -> None:
    action = np.zeros((4, 2))
    action[1:3] = np.nan
    monitor = build(build.networks(action, np.zeros(4)))
    batch = monitor.decide_batch(np.tile(at_rest, (4, 1)))
    assert batch.mode.tolist() == ["nominal", "fallback", "fallback", "nominal"]
    assert batch.opened_by.tolist() == ["always", "fault", "fault", "always"]
    assert monitor.faults.counts == {"networks": 2}


def test_at_speed_the_fallback_brakes_along_the_plan_where_zero_thrust_drives_through(build, hand) -> None:
    # 1.2 m/s, a hazard 0.62 m ahead: coasting would end in its middle.
    hazard = np.array([[0.62, 0.0]])
    for source in (hazard, None):
        monitor = build(build.networks([[1.0, 0.0]], [0.0]))
        at = np.array([0.0, 0.0, 0.0, 1.2, 0.0, 0.0])
        decision = monitor.decide(hand.observe(hazard, (1.2, 0.0)), source)
        assert decision.mode == Mode.NOMINAL  # there is still time
        assert (decision.plan[:, 0] < 0.0).any()
        at = hand.step_exactly(at, decision.action)
        coasting, least, least_coasting = at.copy(), np.inf, np.inf
        memory, actions = decision.memory, []
        for _ in range(120):
            decision = monitor.decide(np.full(60, np.nan), source, memory)
            assert decision.mode == Mode.FALLBACK
            memory = decision.memory
            actions.append(decision.action)
            at = hand.step_exactly(at, decision.action)
            coasting = hand.step_exactly(coasting, np.zeros(2))
            least = min(least, np.linalg.norm(hazard[0] - at[:2]))
            least_coasting = min(least_coasting, np.linalg.norm(hazard[0] - coasting[:2]))
        assert least > HAZARD_RADIUS
        assert least_coasting < 0.05
        assert actions[0][0] == -0.05
        assert actions[-1].tolist() == [0.0, 0.0]
        assert np.hypot(*at[3:5]) < 0.2


@pytest.mark.parametrize("gate", ["always", "risk"])
def test_a_memory_that_was_lost_does_not_blind_the_robot(build, hand, gate) -> None:
    # The observation is sound: with no plan to go on with, what is seen still decides. Coasting would drive
    # through.
    hazard = np.array([[0.62, 0.0]])
    monitor = build(build.networks([[1.0, 0.0]], [0.0]), gate=gate, threshold=1e9)
    at = np.array([0.0, 0.0, 0.0, 1.2, 0.0, 0.0])
    for _ in range(100):
        seen = hand.in_body_frame(at, hazard)
        motion = hand.in_body_frame(np.array([0, 0, at[2]]), at[None, 3:5])[0]
        decision = monitor.decide(hand.observe(seen, tuple(motion), at[5]), seen, "what memory?")
        assert "memory" in str(decision.reason)
        at = hand.step_exactly(at, decision.action)
        assert np.linalg.norm(hazard[0] - at[:2]) > HAZARD_RADIUS


MARK = 777.0


class Faulty:
    """Decides for the robots of a closed loop; one step in 50 or so, at random, something goes wrong."""

    def __init__(self, build, policy, gate: str, kinds: list[str]) -> None:
        def act(observation):
            action = policy(observation, None, None)
            return np.where(observation[:, :1] == MARK, np.nan, action)

        self.filter = build.filter(None)
        self.monitor = build(build.networks(act, [0.0]), self.filter, gate=gate, threshold=1e9)
        self.rng = np.random.default_rng(11)
        self.kinds = kinds
        self.happened = dict.fromkeys(kinds, 0)
        self.silent = 0

    def decide(self, observation, hazards, memory):
        """The actions and the memory."""
        if self.silent > 0:  # no reply comes back: the robot itself plays on
            self.silent -= 1
            return next_of_plan(memory)
        self.filter.fault = None
        observation = observation.copy()
        if self.rng.random() < 1 / 50:
            # Each kind as often as the others.
            kind = min(self.happened, key=lambda name: (self.happened[name], self.rng.random()))
            rows = self.rng.random(len(observation)) < 0.5
            self.happened[kind] += 1
            if kind == "silence":
                self.silent = int(self.rng.integers(0, 10))
                return next_of_plan(memory)
            if kind == "networks":
                observation[rows, 0] = MARK
            elif kind in ("look", "decide"):
                self.filter.fault, self.filter.where = RuntimeError("broken"), kind
            else:
                observation[rows] = np.nan
        decided = self.monitor.decide_batch(observation, hazards, memory)
        return decided.action, decided.memory


def check_faults(build, hand, drive, gate, source, kinds, steps) -> None:
    faulty = Faulty(build, hand.seeker, gate, kinds)
    memory, speeds = np.zeros(40, MEMORY), []
    for now in drive(steps, seed=33):
        assert (now.cost == 0.0).all(), (now.step, faulty.happened, np.flatnonzero(now.cost))
        known = now.hazards if source == "given" else None
        now.action, memory = faulty.decide(now.observation, known, memory)
        speeds.append(np.hypot(now.observation[:, 3], now.observation[:, 4]).mean())
    assert min(faulty.happened.values()) > 0
    assert np.mean(speeds) > 0.4


KINDS = ["networks", "look", "decide", "observation", "silence"]


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("gate", ["always", "risk"])
def test_faults_of_all_kinds_at_speed_near_hazards(build, hand, drive, gate, source) -> None:
    check_faults(build, hand, drive, gate, source, KINDS, 700)


@pytest.mark.long
@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("gate", ["always", "risk"])
@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_fault_for_whole_episodes(build, hand, drive, gate, source, kind) -> None:
    check_faults(build, hand, drive, gate, source, [kind], 999)


@pytest.mark.parametrize("source", ["given", "lidar"])
def test_bad_memories_in_closed_loop(build, hand, drive, source) -> None:
    # One robot at a time: now and then it hands in what is no memory.
    rng = np.random.default_rng(4)
    networks = build.networks(None, [0.0])
    monitor = build(networks, gate="risk", threshold=1e9)
    memories = [np.zeros(1, MEMORY)] * 8
    lost = 0
    for now in drive(400, n=8, seed=41):
        assert (now.cost == 0.0).all(), (now.step, lost)
        actions = hand.seeker(now.observation, now.hazards, None)
        sent = np.zeros((8, 2))
        for k in range(8):
            networks.action = actions[k : k + 1]
            memory = memories[k]
            if rng.random() < 1 / 50:
                memory, lost = [None, "?", np.zeros(2, MEMORY), np.zeros(1)][lost % 4], lost + 1
            known = now.hazards[k] if source == "given" else None
            decision = monitor.decide(now.observation[k], known, memory)
            sent[k], memories[k] = decision.action, decision.memory
        now.action = sent
    assert lost > 20


WRONG_COUNT = """
import sys
import numpy as np
from filter import BarrierFilter
from models import Bundle
from monitor import Monitor

class Networks:
    observation_size = 60
    def run(self, observation):
        return np.tile([1.0, 0.0], (COUNT, 1)), np.zeros(1)

monitor = Monitor(Bundle.load(sys.argv[1]), Networks(), BarrierFilter(), "off")
observation = np.zeros(60)
observation[3] = 1.3
for _ in range(50):
    decision = monitor.decide(observation, [[0.75, 0.02]])
    assert (decision.mode, decision.action.shape) == ("fallback", (2,)), decision
"""


@pytest.mark.parametrize("count", [2, 40])
def test_networks_that_answer_for_more_robots_than_asked_end_in_the_fallback(tiny_bundle, count) -> None:
    # In a process of its own: what runs over an array's end in compiled code takes the process with it.
    script = WRONG_COUNT.replace("COUNT", str(count))
    result = subprocess.run(
        [sys.executable, "-c", script, str(tiny_bundle)],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert result.returncode == 0, result.stderr[-500:]


def test_the_fallback_names_the_plan(build, at_rest) -> None:
    decision = build(build.networks([[np.nan, 0.0]])).decide(at_rest)
    assert (decision.mode, decision.origin) == (Mode.FALLBACK, Origin.PLAN)
    assert decision.barrier == 3.0  # what is known is told
