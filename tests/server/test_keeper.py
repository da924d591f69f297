"""Memory that comes back: what was sealed is taken, and nothing else can make a robot violate."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from decision import MEMORY, Faults, Memory, pack, unpack
from monitor import Monitor
from pointgoal.observation import layout
from server import keeper as module
from server.desk import Desk
from server.duty import Duty
from server.keeper import Keeper, Past

KEY = b"k" * 32
NOBODY = Past(None, None, None)
SHIPPED = Path(__file__).parents[2] / "models" / "pointgoal1"


def memory_with(doubted: int = 0, plan: int = 3) -> np.void:
    memory = np.zeros(1, MEMORY)
    memory["planned"], memory["left"], memory["history"]["age"] = True, plan, 1
    memory["plan"][0, :plan, 0] = -0.05
    memory["history"]["doubted"] = doubted
    return memory[0]


@pytest.fixture
def keeper() -> Keeper:
    return Keeper(KEY, Faults())


def same(memory: Memory | None, other: np.void) -> bool:
    """Whether they are the same but for the seal."""
    assert memory is not None
    return memory.tobytes()[: module._NUMBER] == other.tobytes()[: module._NUMBER]


@pytest.mark.parametrize("robot", [None, "one"])
def test_what_was_sealed_is_taken_back_also_by_another_with_the_key(keeper, robot) -> None:
    text = keeper.seal(memory_with(), robot, "bundle", NOBODY)
    for who in (keeper, Keeper(KEY, Faults())):
        past = who.past(text, 0, robot, "bundle")
        assert past.lost is None
        assert same(past.memory, memory_with())
    assert not keeper._faults.counts


@settings(max_examples=200)
@given(bit=st.integers(0, 8 * MEMORY.itemsize - 1), robot=st.none() | st.just("one"))
def test_a_memory_with_any_bit_changed_is_lost(bit: int, robot: str | None) -> None:
    keeper = Keeper(KEY, Faults())
    data = bytearray(base64.b64decode(keeper.seal(memory_with(), robot, "bundle", NOBODY)))
    data[bit // 8] ^= 1 << bit % 8
    past = keeper.past(pack(bytes(data)), 0, robot, "bundle")
    assert past.lost is not None
    # Nothing of it is gone by: a robot that is known has its own.
    assert past.memory is None or (robot and same_but_age(past.memory))


def same_but_age(memory: Memory) -> bool:
    expected = memory_with()
    expected["history"]["age"] = 0
    return same(memory, expected)


@given(text=st.text(max_size=2000))
def test_whatever_text_comes_is_lost(text: str) -> None:
    assert Keeper(KEY, Faults()).past(text, 0, "one", "bundle").lost is not None


def test_a_seal_is_of_one_key_one_bundle_and_one_robot(keeper) -> None:
    text = keeper.seal(memory_with(), "one", "bundle", NOBODY)
    assert Keeper(b"o" * 32, Faults()).past(text, 0, "one", "bundle").lost
    assert keeper.past(text, 0, "one", "another").lost
    assert keeper.past(text, 0, "two", "bundle").lost
    assert keeper.past(text, 0, None, "bundle").lost
    assert keeper._faults.counts["memory"] == 3


@pytest.mark.parametrize("robot", [None, "one"])
def test_of_an_older_memory_nothing_is_gone_by(keeper, robot) -> None:
    first = keeper.seal(memory_with(plan=9), robot, "bundle", NOBODY)
    past = keeper.past(first, 0, robot, "bundle")
    second = keeper.seal(memory_with(plan=3), robot, "bundle", past)
    replayed = keeper.past(first, 0, robot, "bundle")
    assert replayed.lost is None
    assert same_but_age(replayed.memory)
    assert keeper._faults.counts["memory"] == 1
    assert same(keeper.past(second, 0, robot, "bundle").memory, memory_with())


def test_another_services_newer_memory_is_taken(keeper) -> None:
    other = Keeper(KEY, Faults())
    first = keeper.seal(memory_with(plan=9), "one", "bundle", NOBODY)
    second = other.seal(memory_with(), "one", "bundle", other.past(first, 0, "one", "bundle"))
    assert same(keeper.past(second, 0, "one", "bundle").memory, memory_with())


def test_a_robot_with_a_name_cannot_forget_that_a_sensor_was_caught(keeper) -> None:
    for robot, kept in (("one", True), (None, False)):
        text = keeper.seal(memory_with(doubted=1), robot, "bundle", NOBODY)
        past = keeper.past(None, 0, robot, "bundle")
        assert (past.memory is not None) == kept
        if past.memory is not None:
            assert past.memory["history"]["doubted"] == 1
            assert past.memory["left"] == 3
        assert keeper.past(text, 0, robot, "bundle").memory["history"]["doubted"] == 1
    # Until somebody says that it is a new one.
    assert keeper.forget("one")
    assert not keeper.forget("one")
    assert keeper.past(None, 0, "one", "bundle").memory is None
    # A healthy one starts anew without its memory.
    keeper.seal(memory_with(), "two", "bundle", NOBODY)
    assert keeper.past(None, 0, "two", "bundle").memory is None


def test_what_a_robot_says_it_has_played_cannot_be_more_than_there_was_time_for(keeper, monkeypatch) -> None:
    text = keeper.seal(memory_with(), None, "bundle", NOBODY)
    now = int(unpack(text)["seal"][0, 0])
    for passed, played, left in ((0.0, 3, 3), (0.021, 3, 2), (0.05, 1, 2), (0.05, 9, 1), (9.0, 10**9, 0)):
        monkeypatch.setattr(module.time, "time_ns", lambda passed=passed: now + int(passed * 1e9))
        memory = keeper.past(text, played, None, "bundle").memory
        assert memory["left"] == left
        # What it has done since is its own word: it is not compared with what it sees.
        assert memory["history"]["age"] == 0


def test_a_late_decision_does_not_replace_what_was_sent_meanwhile(keeper) -> None:
    text = keeper.seal(memory_with(), "one", "bundle", NOBODY)
    late = keeper.past(text, 0, "one", "bundle")
    sent = keeper.seal(memory_with(plan=2), "one", "bundle", keeper.past(text, 0, "one", "bundle"))
    keeper.seal(memory_with(plan=1), "one", "bundle", late)
    assert keeper.past(sent, 0, "one", "bundle").memory["left"] == 2


def test_there_is_no_end_of_room_and_whoever_has_a_sensor_caught_goes_last(keeper, monkeypatch) -> None:
    monkeypatch.setattr(module, "MOST_ROBOTS", 4)
    keeper.seal(memory_with(doubted=1), "caught", "bundle", NOBODY)
    for k in range(20):
        keeper.seal(memory_with(), f"robot{k}", "bundle", NOBODY)
    assert list(keeper._last) == ["caught", "robot17", "robot18", "robot19"]


class Attacker:
    """Hands back forged, flipped, replayed memories, another's, none, with false counts."""

    def __init__(self, count: int, often: float, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._often = often
        self._had: list[list[str]] = [[] for _ in range(count)]

    def given(self, k: int, memory: str) -> None:
        """Robot k is sent a memory."""
        self._had[k].append(memory)

    def hands_back(self, k: int) -> dict[str, Any]:
        had, rng = self._had[k], self._rng
        if not had:
            return {}
        if rng.random() >= self._often:
            return {"memory": had[-1]}
        kinds: list[Callable[[], dict[str, Any]]] = [
            dict,
            lambda: {"memory": had[rng.integers(len(had))]},
            lambda: {
                "memory": had[max(0, len(had) - int(rng.integers(1, 30)))],
                "played": int(rng.integers(30)),
            },
            lambda: {"memory": had[-1], "played": int(rng.integers(1, 30))},
            lambda: {"memory": self._had[rng.integers(len(self._had))][-1]},
            lambda: {"memory": self._flipped(had[-1])},
            lambda: {"memory": self._forged(had[-1])},
        ]
        return kinds[rng.integers(len(kinds))]()

    def _flipped(self, text: str) -> str:
        data = bytearray(base64.b64decode(text))
        data[self._rng.integers(len(data))] ^= 1 << int(self._rng.integers(8))
        return pack(bytes(data))

    def _forged(self, text: str) -> str:
        """Full thrust for as long as a plan can last, and a sensor that was caught: the plan goes on."""
        memory = unpack(text)
        memory["planned"], memory["left"], memory["plan"] = True, 20, [1.0, self._rng.uniform(-1, 1)]
        memory["history"]["doubted"] = 1
        return pack(memory.tobytes())


def ask(desk: Desk, observation: np.ndarray, bodies: list[dict[str, Any]]) -> list[dict[str, Any]]:
    robots = [
        {"observation": row.tolist(), "robot": f"robot{k}"} | body
        for k, (row, body) in enumerate(zip(observation, bodies, strict=True))
    ]
    answer = desk.answer(json.dumps({"robots": robots}).encode(), batch=True)
    assert answer.status == 200
    replies: list[dict[str, Any]] = json.loads(answer.body)["replies"]
    return replies


def desk_of(monitor: Monitor) -> Desk:
    return Desk(None, Duty(monitor), Keeper(KEY, monitor.faults))


@pytest.mark.parametrize(("robots", "steps"), [(12, 120), pytest.param(200, 1000, marks=pytest.mark.long)])
def test_no_memory_that_a_client_hands_back_causes_a_violation(drive, robots: int, steps: int) -> None:
    monitor = Monitor.load(SHIPPED)
    desk, attacker = desk_of(monitor), Attacker(robots, 0.3, seed=3)
    violations = fallbacks = 0
    for now in drive(steps, n=robots, seed=11):
        violations += int((now.cost > 0.0).sum())
        if now.step == steps:
            break
        replies = ask(desk, now.observation, [attacker.hands_back(k) for k in range(robots)])
        now.action = np.array([reply["action"] for reply in replies])
        for k, reply in enumerate(replies):
            attacker.given(k, reply["memory"])
            fallbacks += reply["mode"] == "fallback"
    assert violations == 0
    # It did attack, and it was noticed.
    assert monitor.faults.counts["memory"] > 0.1 * robots * steps
    assert fallbacks > 0.05 * robots * steps


@pytest.mark.parametrize("often", [1.0, 0.5])
def test_a_sensor_that_was_caught_stays_caught_whatever_comes_back(drive, often: float) -> None:
    """The hazards' lidar goes blank while robots drive: a client that forgets so must not be served."""
    robots, before, after = 24, 60, 60
    desk, attacker = desk_of(Monitor.load(SHIPPED)), Attacker(robots, often, seed=5)
    caught = np.zeros(robots, np.bool_)
    memory: list[dict[str, Any]] = [{} for _ in range(robots)]
    for now in drive(before + after, n=robots, seed=11):
        assert not (now.cost[caught] > 0.0).any()
        if now.step == before + after:
            break
        observation = now.observation.copy()
        if now.step >= before:
            observation[:, layout(1).slice("hazards_lidar")] = 0.0
        if now.step > before:
            memory = [attacker.hands_back(k) for k in range(robots)]
        replies = ask(desk, observation, memory)
        now.action = np.array([reply["action"] for reply in replies])
        memory = [{"memory": reply["memory"]} for reply in replies]
        for k, reply in enumerate(replies):
            attacker.given(k, reply["memory"])
        doubted = np.array([unpack(reply["memory"])["history"]["doubted"][0] for reply in replies]) > 0
        assert doubted[caught].all()
        caught |= doubted
    assert caught.sum() > robots // 2
