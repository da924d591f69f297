"""What the tests of several rooms need: scenes made by hand, a closed loop, a tiny random bundle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from filter import BarrierFilter
from models import Bundle, Manifest, write_bundle
from pointgoal.observation import HAZARD_RADIUS, layout

FloatArray = NDArray[np.float64]
OPSET = 17


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


def advance_exactly(state: FloatArray, action: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One control step (10 physics steps) of robots (N, 6); the origins on the way, (10, N, 2)."""
    m, inertia, c, h = 5.18879e-3, 2.84218275e-5, 1.927e-2, 0.002
    k, a, b = m * c, m + h * 0.01, inertia + h * 0.005
    x, y, heading, vx, vy, w = np.array(state).T
    way = []
    for _ in range(10):
        sin, cos = np.sin(heading), np.cos(heading)
        push = 0.3 * np.clip(action[:, 0], -0.05, 0.05) + k * w * w
        rx, ry = push * cos - 0.01 * vx, push * sin - 0.01 * vy
        torque = 0.3 * np.clip(action[:, 1] - 0.3 * w, -0.05, 0.05) - 0.005 * w
        spin = (torque + k * (sin * rx - cos * ry) / a) / (b - k * k / a)
        vx, vy, w = vx + h * (rx + k * sin * spin) / a, vy + h * (ry - k * cos * spin) / a, w + h * spin
        x, y, heading = x + h * vx, y + h * vy, heading + h * w
        way.append(np.stack([x, y], axis=1))
    return np.stack([x, y, heading, vx, vy, w], axis=1), np.array(way)


def in_body_frame(state: FloatArray, places: FloatArray) -> FloatArray:
    """Places (n, 2) as a robot at (x, y, heading, ...) sees them."""
    cos, sin = np.cos(state[2]), np.sin(state[2])
    return (np.asarray(places) - state[:2]) @ np.array([[cos, sin], [-sin, cos]]).T


def least_distance_of_the_plan(
    state: FloatArray, action: FloatArray, memory: NDArray[np.void], hazards: FloatArray
) -> FloatArray:
    """Least distance (N,) to hazards (N, n, 2) under the action and then all of what is remembered."""
    least = np.full(len(state), np.inf)
    for step in range(1 + int(memory["left"].max(initial=0)) + 10):
        state, way = advance_exactly(state, action)
        gaps = np.linalg.norm(way[:, :, None] - hazards[None], axis=3).min(axis=(0, 2))
        least = np.minimum(least, gaps)
        there = (step < memory["left"])[:, None]
        action = np.where(there, memory["plan"][:, min(step, memory["plan"].shape[1] - 1)], 0.0)
    # It coasts, and no longer turns: along a straight line to the stop point.
    lever = 1.927e-2 * state[:, 5]
    motion = state[:, 3:5] + lever[:, None] * np.stack([-np.sin(state[:, 2]), np.cos(state[:, 2])], axis=1)
    rest = (5.18879e-3 / 0.01 * motion)[:, None]
    away = hazards - state[:, None, :2]
    share = np.clip((away * rest).sum(axis=2) / np.maximum((rest**2).sum(axis=2), 1e-12), 0.0, 1.0)
    return np.minimum(least, np.linalg.norm(away - share[..., None] * rest, axis=2).min(axis=1))


def attacker(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Full thrust, steering at the nearest hazard."""
    nearest = hazards[np.arange(len(hazards)), np.linalg.norm(hazards, axis=2).argmin(axis=1)]
    turn = np.clip(4 * np.arctan2(nearest[:, 1], nearest[:, 0]), -1, 1)
    return np.stack([np.ones(len(hazards)), turn], axis=1)


def seeker(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Full thrust at the goal, blind to hazards: it steers the stop point."""
    lidar, row = observation[:, 12:28], np.arange(len(observation))
    best = lidar.argmax(axis=1)
    strongest = np.maximum(lidar[row, best], 1e-9)
    bearing = (best + lidar[row, (best + 1) % 16] / strongest) * np.pi / 8
    distance = 3.0 * (1.0 - strongest)
    x = distance * np.cos(bearing) - 0.4 * observation[:, 3]
    y = distance * np.sin(bearing) - 0.4 * observation[:, 4]
    return np.stack([np.ones(len(row)), np.clip(4 * np.arctan2(y, x), -1, 1)], axis=1)


def random_policy(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Anything."""
    return rng.uniform(-1, 1, (len(observation), 2))


def full_thrust(observation: FloatArray, hazards: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Straight on."""
    return np.tile([1.0, 0.0], (len(observation), 1))


@dataclass
class Moment:
    """One step of a closed loop: what N robots see, and what is sent next.

    Attributes:
        env: the simulation.
        step: from 0.
        observation: (N, 60).
        hazards: (N, n, 2) the true ones in the body frame [m].
        action: (N, 2) to be set before the next moment.
        cost: (N,) of the step before.
        reward: (N,) of the step before.
    """

    env: object
    step: int
    observation: FloatArray
    hazards: FloatArray
    action: FloatArray | None = None
    cost: FloatArray | None = None
    reward: FloatArray | None = None

    @property
    def state(self) -> FloatArray:
        """(N, 6) the true states in the body frame."""
        pose, velocity = self.env.pose, self.env.velocity
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        ahead = cos * velocity[:, 0] + sin * velocity[:, 1]
        left = cos * velocity[:, 1] - sin * velocity[:, 0]
        zero = np.zeros(len(pose))
        return np.stack([zero, zero, zero, ahead, left, velocity[:, 2]], axis=1)


class Hand:
    """What tests make by hand."""

    scan = staticmethod(scan)
    observe = staticmethod(observe)
    step_exactly = staticmethod(step_exactly)
    advance_exactly = staticmethod(advance_exactly)
    in_body_frame = staticmethod(in_body_frame)
    least_distance_of_the_plan = staticmethod(least_distance_of_the_plan)
    attacker = staticmethod(attacker)
    seeker = staticmethod(seeker)
    random = staticmethod(random_policy)
    full_thrust = staticmethod(full_thrust)


@pytest.fixture(scope="session")
def hand() -> type[Hand]:
    return Hand


@pytest.fixture(scope="session")
def drive() -> Callable[..., Iterator[Moment]]:
    """Drives N robots in the simulation: each moment's action is sent before the next moment."""

    def drive(steps: int, n: int = 40, seed: int = 7, level: int = 1) -> Iterator[Moment]:
        from pointgoal.vector import PointGoalVectorEnv

        env = PointGoalVectorEnv(level=level, num_envs=n, num_threads=1)
        try:
            observation, info = env.reset(seed=seed)
            reward = np.zeros(n)
            for step in range(steps):
                moment = Moment(
                    env, step, observation, env.hazards_in_body_frame(), None, info["cost"], reward
                )
                yield moment
                observation, reward, _, _, info = env.step(moment.action)
            yield Moment(env, steps, observation, env.hazards_in_body_frame(), None, info["cost"], reward)
        finally:
            env.close()

    return drive


@pytest.fixture(scope="session")
def robot_filter() -> BarrierFilter:
    """A pure filter: nobody guides."""
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


@pytest.fixture(scope="session")
def scenes(draw_scene) -> Callable[..., tuple[FloatArray, FloatArray, FloatArray]]:
    """Draws N scenes: observations (N, 60), actions (N, 2), hazards (N, 8, 2)."""

    def many(n: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
        rng = np.random.default_rng(seed)
        return tuple(np.array(part) for part in zip(*(draw_scene(rng) for _ in range(n)), strict=True))

    return many


def mlp(
    output: str, outputs: int, seed: int, size: int = 60, nodes: list[onnx.NodeProto] | None = None
) -> bytes:
    """A one-layer network "observation" → output; `nodes` go from "raw" to the output (by default a clip)."""
    rng = np.random.default_rng(seed)
    weights = numpy_helper.from_array(rng.normal(0, 0.3, (outputs, size)).astype(np.float32), "weights")
    tail = nodes or [helper.make_node("Tanh", ["raw"], [output])]
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["observation", "weights"], ["raw"], transB=1), *tail],
        output,
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", size])],
        [
            helper.make_tensor_value_info(
                output, TensorProto.FLOAT, ["batch", 2] if outputs == 2 else ["batch"]
            )
        ],
        [weights, numpy_helper.from_array(np.array([-1]), "flat")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    return bytes(model.SerializeToString())


def multiplier_mlp(seed: int = 1, size: int = 60, nodes: list[onnx.NodeProto] | None = None) -> bytes:
    """A multiplier network: a Softplus of one linear layer, flattened to [batch]."""
    tail = nodes or [
        helper.make_node("Softplus", ["raw"], ["positive"]),
        helper.make_node("Reshape", ["positive", "flat"], ["multiplier"]),
    ]
    return mlp("multiplier", 1, seed, size, tail)


def manifest(level: int = 1, **changes: object) -> Manifest:
    """A manifest that fits the tiny networks."""
    blocks = layout(level)
    fields: dict[str, object] = {
        "name": "tiny",
        "created": datetime(2026, 1, 1, tzinfo=UTC),
        "task": f"PointGoal{level}-v0",
        "level": level,
        "algorithm": "random",
        "observation_layout": blocks.to_json(),
        "observation_size": blocks.size,
        "action_low": [-1.0, -1.0],
        "action_high": [1.0, 1.0],
        "threshold": 0.5,
        "threshold_source": "set by hand",
        "hazard_radius": HAZARD_RADIUS,
        "opset": OPSET,
    }
    return Manifest.model_validate(fields | changes)


@pytest.fixture(scope="session")
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of level 1 with random weights, shared by all tests: do not change it."""
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture
def own_bundle(tmp_path: Path) -> Path:
    """A bundle like `tiny_bundle` that a test may damage."""
    return make_bundle(tmp_path / "tiny")


def make_bundle(
    path: Path, policy: bytes | None = None, multiplier: bytes | None = None, level: int = 1
) -> Path:
    """Writes a bundle of tiny networks, or of the given ones."""
    size = layout(level).size
    bundle: Bundle = write_bundle(
        path,
        policy or mlp("action", 2, 0, size),
        multiplier or multiplier_mlp(1, size),
        manifest(level),
    )
    return bundle.path


@pytest.fixture
def make_bundle_of() -> Callable[..., Path]:
    """Makes a bundle of tiny networks at a level, the multiplier's ending in some operators of one input."""

    def make(path: Path, level: int = 1, multiplier_tail: list[str] | None = None) -> Path:
        if multiplier_tail is None:
            return make_bundle(path, level=level)
        names = ["flattened", *(f"tail{k}" for k in range(1, len(multiplier_tail))), "multiplier"]
        nodes = [
            helper.make_node("Softplus", ["raw"], ["positive"]),
            helper.make_node("Reshape", ["positive", "flat"], ["flattened"]),
            *(
                helper.make_node(operator, [before], [after])
                for operator, before, after in zip(multiplier_tail, names[:-1], names[1:], strict=True)
            ),
        ]
        return make_bundle(path, multiplier=multiplier_mlp(nodes=nodes), level=level)

    return make
