"""Observations made by hand, and the robot's dynamics written down a second time."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from filter import BarrierFilter

FloatArray = NDArray[np.float64]


def scan(places: FloatArray) -> FloatArray:
    """The pseudo-lidar (16,) of things at (n, 2) in the body frame, as the task defines it."""
    readings = np.zeros(16)
    for x, y in places:
        reading = max(0.0, 3.0 - np.hypot(x, y)) / 3.0
        place = np.remainder(np.arctan2(y, x), 2 * np.pi) / (2 * np.pi / 16)
        b = int(place)
        share = place - b
        b %= 16
        readings[b] = max(readings[b], reading)
        readings[(b + 1) % 16] = max(readings[(b + 1) % 16], share * reading)
        readings[(b - 1) % 16] = max(readings[(b - 1) % 16], (1 - share) * reading)
    return readings


def observe(
    hazards: FloatArray,
    velocity: tuple[float, float] = (0.0, 0.0),
    yaw_rate: float = 0.0,
    goal: object = None,
) -> FloatArray:
    """An observation (60,) with the blocks that the filter reads."""
    observation = np.zeros(60)
    observation[3:5] = velocity
    observation[8] = yaw_rate
    if goal is not None:
        observation[12:28] = scan(np.array([goal]))
    observation[28:44] = scan(np.asarray(hazards).reshape(-1, 2))
    return observation


def step_exactly(state: FloatArray, action: FloatArray) -> FloatArray:
    """One control step of the robot's (x, y, heading, vx, vy, yaw rate), by the mass matrix in full."""
    m, inertia, c, h = 5.18879e-3, 2.84218275e-5, 1.927e-2, 0.002
    damping = np.diag([0.01, 0.01, 0.005])
    state = np.array(state, dtype=float)
    for _ in range(10):
        heading, w = state[2], state[5]
        sin, cos = np.sin(heading), np.cos(heading)
        mass = np.array([[m, 0, -m * c * sin], [0, m, m * c * cos], [-m * c * sin, m * c * cos, inertia]])
        thrust = 0.3 * np.clip(action[0], -0.05, 0.05)
        torque = 0.3 * np.clip(action[1] - 0.3 * w, -0.05, 0.05)
        centrifugal = m * c * w * w * np.array([cos, sin, 0.0])
        force = np.array([thrust * cos, thrust * sin, torque]) + centrifugal - damping @ state[3:]
        state[3:] += h * np.linalg.solve(mass + h * damping, force)
        state[:3] += h * state[3:]
    return state


class Hand:
    """What tests of the filter make by hand."""

    scan = staticmethod(scan)
    observe = staticmethod(observe)
    step_exactly = staticmethod(step_exactly)


@pytest.fixture(scope="session")
def hand() -> type[Hand]:
    return Hand


@pytest.fixture(scope="session")
def robot_filter() -> BarrierFilter:
    return BarrierFilter()


@pytest.fixture(scope="session")
def draw_scene() -> Callable[[np.random.Generator], tuple[FloatArray, FloatArray, FloatArray]]:
    """Draws an observation, an action and hazards (8, 2) near the robot, none of which it is inside of."""

    def draw(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
        distance = rng.uniform(0.24, 1.5, 8)
        bearing = rng.uniform(-np.pi, np.pi, 8)
        hazards = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
        speed, course = rng.uniform(0.0, 1.2), rng.uniform(-np.pi, np.pi)
        velocity = (speed * np.cos(course), speed * np.sin(course))
        goal = rng.uniform(-1.5, 1.5, 2)
        return observe(hazards, velocity, rng.uniform(-3, 3), goal), rng.uniform(-1, 1, 2), hazards

    return draw
