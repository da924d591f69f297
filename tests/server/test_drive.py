"""A robot at speed near a hazard whose service stops answering: the plan in its memory keeps it clear."""

from __future__ import annotations

import json
import socket

import numpy as np
import pytest
from fastapi.testclient import TestClient

from filter import BarrierFilter, FilterConfig, Robot
from inference import Networks
from models import Bundle
from monitor import Monitor
from pointgoal.observation import HAZARD_RADIUS
from server import Client
from server.app import create_app
from system.point_robot import State, advance

ROBOT = Robot()
HAZARD = np.array([1.6, 0.02])
START = State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class FullAhead(Networks):
    """A policy that drives straight at the hazard."""

    def __init__(self, bundle: Bundle) -> None:
        self.observation_size = bundle.manifest.observation_size

    def run(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.tile([1.0, 0.0], (len(observation), 1)), np.ones(len(observation))


def seen(state: State) -> tuple[np.ndarray, list[list[float]]]:
    """The observation (60,), whose lidar is blank, and the hazard in the body frame."""
    cos, sin = np.cos(state.heading), np.sin(state.heading)
    turned = np.array([[cos, sin], [-sin, cos]])
    observation = np.zeros(60)
    observation[2] = 9.81
    observation[3:5] = turned @ (state.vx, state.vy)
    observation[8] = state.yaw_rate
    observation[9:11] = turned @ (0.0, -0.5)
    return observation, [(turned @ (HAZARD - (state.x, state.y))).tolist()]


def drive(state: State, action: np.ndarray) -> tuple[State, float]:
    """One control step, and the least distance to the hazard's edge on the way [m]."""
    least = np.inf
    for _ in range(ROBOT.substeps):
        state = advance(ROBOT, state, float(action[0]), float(action[1]), 1)
        least = min(least, float(np.hypot(*(HAZARD - (state.x, state.y)))) - HAZARD_RADIUS)
    return state, least


def hang_up(connection: socket.socket) -> None:
    connection.shutdown(socket.SHUT_RDWR)


def say_nothing(connection: socket.socket) -> None:
    """Leaves the client to its time-out."""


def nonsense(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 100000000000000000000\r\n\r\n{")


@pytest.mark.parametrize("fault", [hang_up, pytest.param(say_nothing, marks=pytest.mark.long), nonsense])
def test_no_violation_whenever_the_service_stops_answering(fake, tiny_bundle, fault) -> None:
    bundle = Bundle.load(tiny_bundle)
    monitor = Monitor(bundle, FullAhead(bundle), BarrierFilter(FilterConfig(robot=ROBOT)), "always")
    app = TestClient(create_app(monitor))
    broken: list[bool] = []

    def act(connection: socket.socket, asked: bytes) -> None:
        if broken:
            fault(connection)
            return
        body = app.post("/act", content=asked).content
        connection.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n" % len(body) + body)

    moments = []
    with fake(monitor, act) as url:
        with Client(url, timeout=5.0) as client:
            state, memory = START, None
            for _ in range(150):
                decision = client.decide(*seen(state), memory)
                assert decision.opened_by != "fault", decision.reason
                state, least = drive(state, decision.action)
                assert least >= 0.0
                memory = decision.memory
                moments.append((state, memory))
        broken.append(True)
        # Where coasting from now on would end in the hazard, and the robot is fast.
        wild = [(state, memory) for state, memory in moments if coasting(state) < 0.0]
        assert len(wild) >= 3
        assert max(np.hypot(state.vx, state.vy) for state, _ in wild) > 1.0
        with Client(url, timeout=0.02) as client:
            for moment in wild[:: max(1, len(wild) // 5)]:
                play(client, *moment)


def play(client: Client, state: State, memory: np.void) -> None:
    """Drives on without a service: the plan, then coasting, and never into the hazard."""
    assert memory["left"] > 0
    for _ in range(60):
        decision = client.decide(*seen(state), memory)
        assert (decision.mode, decision.origin, decision.opened_by) == ("fallback", "plan", "fault")
        memory = decision.memory
        state, least = drive(state, decision.action)
        assert least >= 0.0
    assert memory["left"] == 0
    assert np.hypot(state.vx, state.vy) < 0.2


def coasting(state: State) -> float:
    """The least distance to the hazard's edge if the robot coasts from here [m]."""
    nearest = np.inf
    for _ in range(60):
        state, least = drive(state, np.zeros(2))
        nearest = min(nearest, least)
    return nearest


def test_the_scene_is_what_the_service_sees() -> None:
    observation, hazards = seen(State(1.0, 0.0, np.pi / 2, 0.0, 0.5, 0.0))
    assert json.loads(json.dumps(hazards)) == [[pytest.approx(0.02), pytest.approx(-0.6)]]
    assert observation[3:5] == pytest.approx([0.5, 0.0])
