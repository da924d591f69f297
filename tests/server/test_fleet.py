"""Several robots on one service: each gets its own decision, as from the monitor itself."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest

from decision import MEMORY, Decisions
from evaluation.service import Service
from monitor import Monitor
from pointgoal.lidar import encode
from pointgoal.observation import layout
from pointgoal.vector import PointGoalVectorEnv
from server import Client, ClientError, Fleet


@pytest.fixture(scope="module")
def service(tiny_bundle: Path):
    with Service.start(tiny_bundle, "always") as running:
        yield running


def test_one_protocol() -> None:
    for name in ("decide", "decide_batch"):
        asked = inspect.signature(getattr(Monitor, name))
        assert inspect.signature(getattr(Fleet, name)) == asked
    assert inspect.signature(Client.decide) == inspect.signature(Monitor.decide)


def test_it_decides_as_the_monitor_does(service, monitor) -> None:
    rng = np.random.default_rng(3)
    memory = past = None
    with Fleet(service.url, layout(1).to_json(), timeout=5.0) as fleet:
        assert fleet.model().model == monitor.bundle.id
        for count in (5, 5, 5):
            observation = rng.uniform(0.0, 0.5, (count, 60))
            observation[1:, 28:44] = encode(rng.uniform(-1.5, 1.5, (count - 1, 3, 2)))
            hazards = rng.uniform(-1.0, 1.0, (count, 4, 2))
            hazards[1, 2] = hazards[3, 0] = np.nan  # rows that stand for none
            told = fleet.decide_batch(observation, hazards, memory)
            decided = monitor.decide_batch(observation, hazards, past)
            assert isinstance(told, Decisions)
            for name in ("action", "mode", "origin", "certified", "barrier", "hazard", "opened_by"):
                np.testing.assert_array_equal(getattr(told, name), getattr(decided, name), err_msg=name)
            assert np.allclose(told.risk, decided.risk, rtol=1e-6)
            assert (told.reason, told.threshold) == (decided.reason, decided.threshold)
            memory, past = told.memory, decided.memory
            unsealed = memory.copy()
            unsealed["seal"] = 0
            assert unsealed.tobytes() == past.tobytes()
        one = fleet.decide(observation[2], hazards[2], memory[2])
        assert one.action.tobytes() == monitor.decide(observation[2], hazards[2], past[2]).action.tobytes()
        # Fewer robots than before are the first ones.
        assert len(fleet.decide_batch(observation[:2])) == 2
        assert sum(fleet.faults.counts.values()) == 0


def test_one_robots_bad_input_leaves_the_others_alone(service, monitor) -> None:
    observation = np.full((3, 60), 0.25)
    observation[1, 7] = np.nan
    with Fleet(service.url, timeout=5.0) as fleet:
        decisions = fleet.decide_batch(observation)
        assert [reason is None for reason in decisions.reason] == [True, False, True]
        assert decisions.action[1].tolist() == [0.0, 0.0]
        assert sum(fleet.faults.counts.values()) == 1


@pytest.mark.parametrize(
    ("observation", "hazards", "memory"),
    [
        (np.zeros(60), None, None),
        (np.zeros((0, 60)), None, None),
        (np.zeros((2, 60)), np.zeros((3, 1, 2)), None),
        (np.zeros((2, 60)), np.zeros((2, 2)), None),
        (np.zeros((2, 60)), None, np.zeros(3, MEMORY)),
        (np.zeros((2, 60)), None, np.zeros(2)),
    ],
)
def test_what_is_not_of_n_robots_is_refused(service, observation, hazards, memory) -> None:
    with (
        Fleet(service.url, timeout=5.0) as fleet,
        pytest.raises(ValueError, match=r"observation|hazards|memory"),
    ):
        fleet.decide_batch(observation, hazards, memory)


def test_a_service_that_is_not_there() -> None:
    with pytest.raises(ClientError):
        Fleet("http://127.0.0.1:1")


def test_a_service_killed_on_the_drive_harms_nobody(tiny_bundle: Path) -> None:
    count = 24
    env = PointGoalVectorEnv(level=1, num_envs=count, num_threads=1)
    observation, _ = env.reset(seed=7)
    memory, moved = None, np.zeros(count)
    with Service.start(tiny_bundle, "always") as service, Fleet(service.url, timeout=5.0) as fleet:
        for step in range(160):
            if step == 60:
                service.process.kill()
                service.process.wait()
                assert (memory["left"] > 0).sum() >= 3, "no robot has anything to play"
            decisions = fleet.decide_batch(observation, env.hazards_in_body_frame(), memory)
            if step >= 60:
                assert (decisions.mode == "fallback").all()
                assert (decisions.opened_by == "fault").all()
            memory = decisions.memory
            observation, _, _, _, info = env.step(decisions.action)
            assert (info["cost"] == 0.0).all(), step
            moved = np.maximum(moved, np.linalg.norm(env.velocity[:, :2], axis=1)) if step >= 60 else moved
    env.close()
    assert (memory["left"] == 0).all()
    assert moved.max() > 0.3
