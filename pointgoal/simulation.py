"""Many robots in one MuJoCo batch: physics, reward, cost, goals and observations, without gymnasium."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from pointgoal.layouts import sample_goal, sample_layout
from pointgoal.lidar import show
from pointgoal.observation import HAZARD_RADIUS, LIDAR_BINS, NUM_HAZARDS, NUM_VASES, FloatArray, layout
from pointgoal.scene import PHYSICS_STEPS, ROBOT_QPOS, VASE_HEIGHT, VASE_QPOS, VASE_QVEL, build_scene

BoolArray = NDArray[np.bool_]
CostKind = Literal["depth", "indicator"]

EPISODE_STEPS = 1000
"""Control steps after which an episode is truncated."""
GOAL_RADIUS = 0.3
"""The goal is met at this distance of the robot's origin [m]."""
REWARD_LIMIT = 10.0
"""Rewards are clipped to ± this."""
MOST = 1e4
"""Largest number of a state that a robot is put into, in metres, radians and seconds."""
VASE_SPEED_THRESHOLD = 1e-4
"""Level 2: a vase slower than this costs nothing [m/s]."""

_SENSOR_NUMBERS = 12
_RNG_WORDS = 6


@dataclass
class StepResult:
    """What one control step of n robots gave.

    Attributes:
        observation: (n, 28 or 60).
        reward: (n,).
        cost: (n,).
        terminated: (n,) a met goal could not be placed anew.
        truncated: (n,) the episode's 1,000 steps are over.
    """

    observation: FloatArray
    reward: FloatArray
    cost: FloatArray
    terminated: BoolArray
    truncated: BoolArray

    @staticmethod
    def concatenate(results: Sequence[StepResult]) -> StepResult:
        """The results of several simulations as one, in order."""
        if len(results) == 1:
            return results[0]
        columns = zip(*(vars(result).values() for result in results), strict=True)
        return StepResult(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class State:
    """An exact state of n robots and their surroundings, to start from.

    Attributes:
        pose: (n, 3) x, y [m], heading [rad], in the world.
        velocity: (n, 3) vx, vy [m/s] in the world, yaw rate [rad/s].
        goal: (n, 2) [m].
        hazards: (n, h, 2) [m].
        vase_qpos: (n, m, 7) position [m] and quaternion.
        vase_qvel: (n, m, 6) linear [m/s] and angular [rad/s] velocity.
    """

    pose: FloatArray
    velocity: FloatArray
    goal: FloatArray
    hazards: FloatArray
    vase_qpos: FloatArray
    vase_qvel: FloatArray

    def rows(self, rows: NDArray[np.intp] | slice) -> State:
        """The chosen robots' states."""
        return State(**{name: array[rows] for name, array in vars(self).items()})

    @staticmethod
    def shapes(level: int, n: int) -> dict[str, tuple[int, ...]]:
        """Name → shape of n robots' arrays."""
        h, m = NUM_HAZARDS[level], NUM_VASES[level]
        return {
            "pose": (n, 3),
            "velocity": (n, 3),
            "goal": (n, 2),
            "hazards": (n, h, 2),
            "vase_qpos": (n, m, VASE_QPOS),
            "vase_qvel": (n, m, VASE_QVEL),
        }

    @staticmethod
    def from_mapping(state: Mapping[str, object], level: int, n: int) -> State:
        """Check a mapping of arrays and make a state of it.

        Raises:
            ValueError: naming the field that is missing, unknown, of a wrong shape or out of range.
        """
        shapes = State.shapes(level, n)
        unknown = sorted(set(state) - set(shapes))
        if unknown:
            raise ValueError(f"state has unknown fields {unknown}; it takes {sorted(shapes)}")
        arrays = {}
        for name, shape in shapes.items():
            if name not in state:
                raise ValueError(f"state lacks {name!r} of shape {shape}")
            array = np.asarray(state[name], dtype=np.float64)
            if array.shape != shape:
                raise ValueError(f"state {name!r} has shape {array.shape}, expected {shape}")
            # Once a number or an acceleration is beyond 1e10, MuJoCo puts everything back to its place.
            if not (np.abs(array) <= MOST).all():
                raise ValueError(f"state {name!r} must be finite and within ±{MOST:g}")
            arrays[name] = array
        return State(**arrays)


class Simulation:
    """n robots, each in its own surroundings, stepped together on one thread.

    Rows are independent: what a row does depends on its own generator, state and actions alone. Copies, by
    `copy` or `pickle`, go on alike, to the last bit.

    Args:
        level: 0, 1 or 2.
        n: how many robots.
        cost: the cost of a step, in metres or as an indicator.
        model: the scene; None: the level's own.
        episode_steps: control steps after which an episode is truncated; None: never.
    """

    def __init__(
        self,
        level: int,
        n: int,
        cost: CostKind = "depth",
        model: mujoco.MjModel | None = None,
        episode_steps: int | None = EPISODE_STEPS,
    ) -> None:
        if cost not in ("depth", "indicator"):
            raise ValueError(f"cost must be 'depth' or 'indicator', got {cost!r}")
        self.level = level
        self.n = n
        self.cost_kind = cost
        self.layout = layout(level)
        self.model = build_scene(level) if model is None else model
        self.batch = Batch(self.model, n, nthread=1, persistent=True)
        # The sensors are read once a control step: on the way there they would cost a tenth of the physics.
        self._sensorless = copy.copy(self.model)
        self._sensorless.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._qpos: FloatArray = self.batch.bind("qpos")
        self._qvel: FloatArray = self.batch.bind("qvel")
        self._ctrl: FloatArray = self.batch.bind("ctrl")
        self._sensors: FloatArray = self.batch.bind("sensordata")
        self._vase_qpos: FloatArray = self._qpos[:, ROBOT_QPOS:].reshape(n, -1, VASE_QPOS)
        self._vase_qvel: FloatArray = self._qvel[:, ROBOT_QPOS:].reshape(n, -1, VASE_QVEL)
        self.elapsed_steps = np.zeros(n, dtype=np.int64)
        self.episode_steps = episode_steps
        # Where each row's episode began, and what it was sent since.
        self._start = _Start.of(level, n)
        self.rngs = [np.random.default_rng() for _ in range(n)]
        # Everything the lidars see, one column a thing: the goal, the hazards, the vases.
        h, m = NUM_HAZARDS[level], NUM_VASES[level]
        self._hazards, self._vases = slice(1, 1 + h), slice(1 + h, 1 + h + m)
        self._x, self._y = np.zeros((n, 1 + h + m)), np.zeros((n, 1 + h + m))
        self._goal_distance = np.zeros(n)
        # Index of a thing's first lidar number in the flattened observations: one scatter does all.
        channel = np.repeat([0, 1, 2], [1, h, m])
        rows = np.arange(n)[:, None] * self.layout.size
        self._lidar_start = rows + _SENSOR_NUMBERS + channel * LIDAR_BINS

    @property
    def pose(self) -> FloatArray:
        """(n, 3) x, y [m], heading [rad] in the world, a copy."""
        return self._qpos[:, :ROBOT_QPOS].copy()

    @property
    def velocity(self) -> FloatArray:
        """(n, 3) vx, vy [m/s] in the world, yaw rate [rad/s], a copy."""
        return self._qvel[:, :ROBOT_QPOS].copy()

    @property
    def vases(self) -> FloatArray:
        """(n, m, 7) position [m] and quaternion of the vases, a copy."""
        return self._vase_qpos.copy()

    @property
    def vase_velocity(self) -> FloatArray:
        """(n, m, 6) linear [m/s] and angular [rad/s] velocity of the vases, a copy."""
        return self._vase_qvel.copy()

    @property
    def goal(self) -> FloatArray:
        """(n, 2) centre of the goal [m], a copy."""
        return np.stack([self._x[:, 0], self._y[:, 0]], axis=-1)

    @property
    def hazards(self) -> FloatArray:
        """(n, h, 2) centres of the hazards [m], a copy."""
        return np.stack([self._x[:, self._hazards], self._y[:, self._hazards]], axis=-1)

    def hazards_in_body_frame(self) -> FloatArray:
        """(n, h, 2) centres of the hazards as the robot has them: x ahead, y to its left [m]."""
        dx = self._x[:, self._hazards] - self._qpos[:, :1]
        dy = self._y[:, self._hazards] - self._qpos[:, 1:2]
        cos, sin = np.cos(self._qpos[:, 2:3]), np.sin(self._qpos[:, 2:3])
        return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)

    def reset(self, rows: NDArray[np.intp], elapsed_steps: NDArray[np.int64] | int = 0) -> None:
        """Draw a new layout for each of the rows (k,), from its own generator, at those steps of episodes."""
        layouts = [sample_layout(self.rngs[i], self.level) for i in rows]
        k, m = len(rows), NUM_VASES[self.level]
        vase_qpos = np.zeros((k, m, VASE_QPOS))
        for j, drawn in enumerate(layouts):
            vase_qpos[j, :, :2] = drawn.vases
            vase_qpos[j, :, 3] = np.cos(drawn.vase_yaws / 2)
            vase_qpos[j, :, 6] = np.sin(drawn.vase_yaws / 2)
        vase_qpos[:, :, 2] = VASE_HEIGHT
        state = State(
            pose=np.array([drawn.pose for drawn in layouts]),
            velocity=np.zeros((k, 3)),
            goal=np.array([drawn.goal for drawn in layouts]),
            hazards=np.array([drawn.hazards for drawn in layouts]),
            vase_qpos=vase_qpos,
            vase_qvel=np.zeros((k, m, VASE_QVEL)),
        )
        self.set_state(rows, state, elapsed_steps)

    def set_state(
        self, rows: NDArray[np.intp], state: State, elapsed_steps: NDArray[np.int64] | int = 0
    ) -> None:
        """Put rows (k,) into exact states (leading axis k), everything awake, at that step of the episode."""
        k = len(rows)
        self._start.note(rows, state, elapsed_steps, self.rngs)
        # The reset wakes the vases and clears the solver's warm start: nothing of the old episode is left.
        self.batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[rows, :ROBOT_QPOS] = state.pose
        self._qvel[rows, :ROBOT_QPOS] = state.velocity
        self._qpos[rows, ROBOT_QPOS:] = state.vase_qpos.reshape(k, -1)
        self._qvel[rows, ROBOT_QPOS:] = state.vase_qvel.reshape(k, -1)
        self._x[rows, 0], self._y[rows, 0] = state.goal.T
        self._x[rows, self._hazards] = state.hazards[..., 0]
        self._y[rows, self._hazards] = state.hazards[..., 1]
        self.elapsed_steps[rows] = elapsed_steps
        self.batch.forward(rows)
        self._goal_distance[rows] = np.hypot(*(state.goal - state.pose[:, :2]).T)

    def step(self, action: FloatArray) -> StepResult:
        """Advance every row by one control step of 0.02 s.

        The order is the reference task's: simulate, reward, cost, maybe a new goal, observation.

        Args:
            action: (n, 2) thrust and turning, clipped to ±1.
        """
        np.clip(action, -1.0, 1.0, out=self._ctrl)
        self._start.log(self._ctrl)
        self.batch.set_models(self._sensorless)
        self.batch.step(nstep=PHYSICS_STEPS)
        self.batch.set_models(None)
        self.batch.forward()
        dx, dy, distance = self._relative()
        goal_distance = distance[:, 0].copy()
        met = goal_distance <= GOAL_RADIUS
        reward = self._goal_distance - goal_distance + met
        np.clip(reward, -REWARD_LIMIT, REWARD_LIMIT, out=reward)
        cost = self._cost(distance[:, self._hazards])
        terminated = np.zeros(self.n, dtype=np.bool_)
        if met.any():
            for row in np.flatnonzero(met):
                terminated[row] = not self._renew_goal(row)
            dx, dy, distance = self._relative()
        self._goal_distance = distance[:, 0].copy()
        self.elapsed_steps += 1
        truncated = self.elapsed_steps >= (np.inf if self.episode_steps is None else self.episode_steps)
        return StepResult(self._encode(dx, dy, distance), reward, cost, terminated, truncated)

    def observe(self) -> FloatArray:
        """(n, 28 or 60) observations of the present state."""
        return self._encode(*self._relative())

    def _relative(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, k) world-frame offsets x, y from robot to all that the lidars see, and their lengths [m]."""
        self._x[:, self._vases] = self._vase_qpos[:, :, 0]
        self._y[:, self._vases] = self._vase_qpos[:, :, 1]
        dx = self._x - self._qpos[:, :1]
        dy = self._y - self._qpos[:, 1:2]
        return dx, dy, np.sqrt(dx * dx + dy * dy)

    def _cost(self, hazard_distance: FloatArray) -> FloatArray:
        """(n,) cost of the step: depth in hazards, and at level 2 contact with vases and their speed."""
        cost: FloatArray = np.maximum(HAZARD_RADIUS - hazard_distance, 0.0).sum(axis=1)
        if self.level == 2:
            speed = np.linalg.norm(self._vase_qvel[:, :, :3], axis=2)
            cost += self._sensors[:, _SENSOR_NUMBERS] + np.where(speed >= VASE_SPEED_THRESHOLD, speed, 0).sum(
                axis=1
            )
        return (cost > 0).astype(np.float64) if self.cost_kind == "indicator" else cost

    def _renew_goal(self, row: np.intp) -> bool:
        """Draw a row's goal anew against where things stand now; False if there is no place for it."""
        others = np.stack([self._x[row], self._y[row]], axis=-1)
        others[0] = self._qpos[row, :2]
        goal = sample_goal(self.rngs[row], self.level, others)
        if goal is None:
            return False
        self._x[row, 0], self._y[row, 0] = goal
        return True

    def _encode(self, dx: FloatArray, dy: FloatArray, distance: FloatArray) -> FloatArray:
        """(n, 28 or 60) observations from the sensors and the offsets (n, k) of what the lidars see."""
        observation = np.zeros((self.n, self.layout.size))
        observation[:, :_SENSOR_NUMBERS] = self._sensors[:, :_SENSOR_NUMBERS]
        bearing = np.arctan2(dy, dx) - self._qpos[:, 2:3]
        show(observation.reshape(-1), self._lidar_start, bearing, distance)
        return observation

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as arrays with leading axis n; nothing here is touched.

        MuJoCo's own state lacks which vases are asleep, and cannot be told. So this is where each episode
        began and what was sent since: `load_state_dict` drives that again, to the same bits.
        """
        return self._start.state_dict()

    def __getstate__(self) -> dict[str, Any]:
        made_of = self.level, self.n, self.cost_kind, self.model, self.episode_steps
        return {"made_of": made_of, "rngs": self.rngs, "state": self.state_dict()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        level, n, cost, model, episode_steps = state["made_of"]
        Simulation.__init__(self, level, n, cost, model, episode_steps)
        self.rngs = list(state["rngs"])
        self.load_state_dict(state["state"])

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state that `state_dict` gave; as long as simulating its longest episode so far.

        Raises:
            ValueError: naming the array that is missing or of another shape.
        """
        start = _Start.from_state_dict(state, self.level, self.n)
        self._start = _Start.of(self.level, self.n)
        longest = int(start.sent.max(initial=0))
        for step in range(longest + 1):
            rows = np.flatnonzero(start.begun & (longest - start.sent == step))
            if len(rows):
                for row in rows:
                    self.rngs[row] = _unpack_rng(start.rng[row])
                self.set_state(rows, start.state.rows(rows), start.elapsed_steps[rows])
            if step < longest:
                at = np.maximum(start.sent - longest + step, 0)
                # Rows that have not begun are set anew when they do.
                self.step(start.action[np.arange(self.n), at])


@dataclass
class _Start:
    """How n rows' episodes began, and what they were sent since.

    Attributes:
        begun: (n,) whether a row has an episode at all.
        state: the states that they began in.
        elapsed_steps: (n,) of the episode then.
        rng: (n, 6) their generators then.
        action: (n, steps, 2) what was sent, ``sent`` (n,) of them so far.
    """

    begun: BoolArray
    state: State
    elapsed_steps: NDArray[np.int64]
    rng: NDArray[np.uint64]
    action: FloatArray
    sent: NDArray[np.int64]

    @staticmethod
    def of(level: int, n: int) -> _Start:
        """Before any episode."""
        state = State(**{name: np.zeros(shape) for name, shape in State.shapes(level, n).items()})
        return _Start(
            begun=np.zeros(n, np.bool_),
            state=state,
            elapsed_steps=np.zeros(n, np.int64),
            rng=np.zeros((n, _RNG_WORDS), np.uint64),
            action=np.zeros((n, EPISODE_STEPS, 2)),
            sent=np.zeros(n, np.int64),
        )

    def note(
        self,
        rows: NDArray[np.intp],
        state: State,
        elapsed_steps: NDArray[np.int64] | int,
        rngs: Sequence[np.random.Generator],
    ) -> None:
        """New episodes of some rows (k,), in states with leading axis k."""
        self.begun[rows] = True
        for name, array in vars(self.state).items():
            array[rows] = getattr(state, name)
        self.elapsed_steps[rows] = elapsed_steps
        self.rng[rows] = [_pack_rng(rngs[row]) for row in rows]
        self.sent[rows] = 0

    def log(self, action: FloatArray) -> None:
        """One more step of all rows; (n, 2)."""
        most = self.action.shape[1]
        if int(self.sent.max(initial=0)) == most:
            self.action = np.pad(self.action, ((0, 0), (0, most), (0, 0)))
        self.action[np.arange(len(action)), self.sent] = action
        self.sent += 1

    def state_dict(self) -> dict[str, np.ndarray]:
        """Copies of the arrays."""
        numbers = {name: array for name, array in vars(self).items() if name != "state"}
        return {name: array.copy() for name, array in {**numbers, **vars(self.state)}.items()}

    @staticmethod
    def from_state_dict(state: Mapping[str, np.ndarray], level: int, n: int) -> _Start:
        """The inverse of `state_dict`, or ValueError."""
        empty = _Start.of(level, n)
        found = {}
        for name, array in empty.state_dict().items():
            given = state[name].shape if name in state else "nothing"
            # An episode that goes on and on has room for more.
            longer = name == "action" and name in state and state[name].ndim == 3
            shape = (n, state[name].shape[1], 2) if longer else array.shape
            if given != shape:
                raise ValueError(f"simulation state {name!r}: expected shape {shape}, found {given}")
            found[name] = state[name].copy()
        if not ((found["sent"] >= 0) & (found["sent"] <= found["action"].shape[1])).all():
            raise ValueError("simulation state 'sent' counts more steps than there are actions")
        places = State(**{name: found.pop(name) for name in vars(empty.state)})
        return _Start(state=places, **found)


def _pack_rng(rng: np.random.Generator) -> list[int]:
    """A PCG64 generator's state as six 64-bit words."""
    state = rng.bit_generator.state
    words = []
    for name in ("state", "inc"):
        words += [state["state"][name] >> 64, state["state"][name] & (2**64 - 1)]
    return [*words, state["has_uint32"], state["uinteger"]]


def _unpack_rng(words: np.ndarray) -> np.random.Generator:
    """The inverse of `_pack_rng`."""
    state_high, state_low, inc_high, inc_low, has_uint32, uinteger = (int(word) for word in words)
    bits = np.random.PCG64()
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return np.random.Generator(bits)
