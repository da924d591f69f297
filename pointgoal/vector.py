"""Many point robots at once, as a gymnasium vector environment on one MuJoCo batch a thread."""

from __future__ import annotations

import copy
import operator
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from pointgoal.observation import FloatArray, ObservationLayout, layout
from pointgoal.rendering import draw
from pointgoal.scene import build_scene
from pointgoal.seeds import spawn
from pointgoal.simulation import EPISODE_STEPS, CostKind, Simulation, State, StepResult


def observation_space(observation_layout: ObservationLayout) -> spaces.Space[FloatArray]:
    """Lidar readings are in [0, 1]; the sensors are unbounded."""
    low = np.full(observation_layout.size, -np.inf)
    high = np.full(observation_layout.size, np.inf)
    for block in observation_layout.blocks:
        if block.name.endswith("lidar"):
            rows = observation_layout.slice(block.name)
            low[rows], high[rows] = 0.0, 1.0
    return spaces.Box(low, high, dtype=np.float64)


def action_space() -> spaces.Space[FloatArray]:
    """Thrust and turning, in ±1."""
    return spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)


class PointGoalVectorEnv(VectorEnv[FloatArray, FloatArray, FloatArray]):
    """N PointGoal environments, stepped side by side and reset in the step in which they end.

    ``info["cost"]`` (N,) is the cost of the step. On a step on which episodes end, the observations
    returned are the next episodes' first ones; ``info["final_obs"]`` (N, size) holds the last ones in
    the rows that ``info["_final_obs"]`` (N,) marks, and ``info["final_info"]`` their cost.
    Row i seeded with s is the single environment seeded with ``pointgoal.seeds.spawn(s, N)[i]``.

    Args:
        level: 0, 1 or 2.
        num_envs: N.
        cost: ``"depth"``, metres inside hazards (the paper's), or ``"indicator"``, 1 if that is above 0.
        num_threads: threads that share the environments; 0 takes one a CPU.
        render_mode: ``"rgb_array"`` or None.
        max_episode_steps: steps after which an episode is truncated.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": 50,
    }

    def __init__(
        self,
        level: int = 1,
        num_envs: int = 1,
        cost: CostKind = "depth",
        num_threads: int = 0,
        render_mode: str | None = None,
        max_episode_steps: int = EPISODE_STEPS,
    ) -> None:
        if max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1, got {max_episode_steps}")
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if num_threads < 0:
            raise ValueError(f"num_threads must be at least 0, got {num_threads}")
        self.level = level
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.layout = layout(level)
        self.single_observation_space = observation_space(self.layout)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        threads = min(num_threads or os.cpu_count() or 1, num_envs)
        bounds = np.linspace(0, num_envs, threads + 1).astype(int)
        self._slices = [slice(a, b) for a, b in pairwise(bounds)]
        model = build_scene(level)
        self._max_episode_steps = max_episode_steps
        self.simulations = [
            Simulation(level, part.stop - part.start, cost, model, max_episode_steps) for part in self._slices
        ]
        self._threads, self._threads_of = self._start_threads(), os.getpid()
        self._cost = np.zeros(num_envs)
        self._started = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: one number, whose children (`pointgoal.seeds.spawn`) the rows take, or one a row, taken as
                the single environment takes it, or None to go on with the generators; rows that are not
                reset keep theirs.
            options: ``"state"``: an exact state (pose, velocity, goal, hazards, vase_qpos, vase_qvel,
                each with leading axis N); ``"reset_mask"`` (N,) bool: the rows to reset, the others stay
                as they are; ``"elapsed_steps"`` (N,) int: how far into its episode each row starts, to
                stagger episodes.

        Returns:
            (N, size) observations, and an info with zero cost.

        Raises:
            ValueError: naming the option that is wrong.
        """
        options = dict(options or {})
        state, mask = options.pop("state", None), options.pop("reset_mask", None)
        elapsed = options.pop("elapsed_steps", None)
        if options:
            known = ["elapsed_steps", "reset_mask", "state"]
            raise ValueError(f"reset has no options {sorted(options)}; it takes {known}")
        chosen = (
            np.ones(self.num_envs, bool) if mask is None else _rows(mask, bool, self.num_envs, "reset_mask")
        )
        if not self._started and not chosen.all():
            raise ValueError("reset_mask: the first reset must start every environment")
        whole = None if state is None else State.from_mapping(state, self.level, self.num_envs)
        steps = np.zeros(self.num_envs, np.int64)
        if elapsed is not None:
            steps = _rows(elapsed, np.int64, self.num_envs, "elapsed_steps")
            if not ((steps >= 0) & (steps < self._max_episode_steps)).all():
                most = self._max_episode_steps - 1
                raise ValueError(f"elapsed_steps must be 0 to {most}, got {steps.tolist()}")
        self._seed(seed, chosen)
        for simulation, part in zip(self.simulations, self._slices, strict=True):
            rows = np.flatnonzero(chosen[part])
            if not len(rows):
                continue
            if whole is None:
                simulation.reset(rows, steps[part][rows])
            else:
                simulation.set_state(rows, whole.rows(part).rows(rows), steps[part][rows])
        self._started = True
        self._cost = np.where(chosen, 0.0, self._cost)
        observation = np.concatenate([simulation.observe() for simulation in self.simulations])
        return observation, {"cost": self._cost.copy()}

    def step(
        self, actions: FloatArray
    ) -> tuple[FloatArray, FloatArray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every environment by 0.02 s.

        Args:
            actions: (N, 2), clipped to ±1.

        Returns:
            (N, size) observations, (N,) rewards, terminations and truncations, and the info.

        Raises:
            ValueError: if the actions' shape is wrong or one is not finite.
            RuntimeError: before the first reset.
        """
        if not self._started:
            raise RuntimeError("step was called before reset")
        actions = np.asarray(actions, np.float64)
        if actions.shape != (self.num_envs, 2):
            raise ValueError(f"actions have shape {actions.shape}, expected {(self.num_envs, 2)}")
        if not np.isfinite(actions).all():
            raise ValueError("actions are not finite")
        parts = [actions[part] for part in self._slices]
        if self._threads_of != os.getpid():
            # A fork leaves its threads behind.
            self._threads, self._threads_of = self._start_threads(), os.getpid()
        if self._threads is None:
            results = [self.simulations[0].step(parts[0])]
        else:
            results = list(self._threads.map(Simulation.step, self.simulations, parts))
        result = StepResult.concatenate(results)
        info: dict[str, Any] = {"cost": result.cost}
        done = result.terminated | result.truncated
        self._cost = np.where(done, 0.0, result.cost)
        if done.any():
            info["final_obs"], info["_final_obs"] = result.observation.copy(), done
            info["final_info"], info["_final_info"] = {"cost": result.cost, "_cost": done}, done
            for simulation, part in zip(self.simulations, self._slices, strict=True):
                rows = np.flatnonzero(done[part])
                if len(rows):
                    simulation.reset(rows)
                    result.observation[part] = simulation.observe()
        return result.observation, result.reward, result.terminated, result.truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture (height, width, 3) uint8 for each environment, or None without a render mode."""
        if self.render_mode is None:
            return None
        pictures = []
        for simulation, part in zip(self.simulations, self._slices, strict=True):
            pictures += [draw(simulation, row, cost) for row, cost in enumerate(self._cost[part])]
        return tuple(pictures)

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads."""
        if self._threads is not None and self._threads_of == os.getpid():
            self._threads.shutdown()

    def _start_threads(self) -> ThreadPoolExecutor | None:
        return ThreadPoolExecutor(len(self._slices), "pointgoal") if len(self._slices) > 1 else None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_threads"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._threads, self._threads_of = self._start_threads(), os.getpid()

    def __copy__(self) -> PointGoalVectorEnv:
        """As `copy.deepcopy`: two environments that share a simulation would drive one robot."""
        return copy.deepcopy(self)

    @property
    def pose(self) -> FloatArray:
        """(N, 3) x, y [m], heading [rad] in the world."""
        return np.concatenate([simulation.pose for simulation in self.simulations])

    @property
    def velocity(self) -> FloatArray:
        """(N, 3) vx, vy [m/s] in the world, yaw rate [rad/s]."""
        return np.concatenate([simulation.velocity for simulation in self.simulations])

    @property
    def goal(self) -> FloatArray:
        """(N, 2) centres of the goals [m]."""
        return np.concatenate([simulation.goal for simulation in self.simulations])

    @property
    def hazards(self) -> FloatArray:
        """(N, h, 2) centres of the hazards [m]."""
        return np.concatenate([simulation.hazards for simulation in self.simulations])

    @property
    def elapsed_steps(self) -> NDArray[np.int64]:
        """(N,) steps since the episodes' starts."""
        return np.concatenate([simulation.elapsed_steps for simulation in self.simulations])

    def hazards_in_body_frame(self) -> FloatArray:
        """(N, h, 2) centres of the hazards: x ahead of the robot, y to its left [m]."""
        return np.concatenate([simulation.hazards_in_body_frame() for simulation in self.simulations])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as arrays; see `Simulation.state_dict`."""
        parts = [simulation.state_dict() for simulation in self.simulations]
        state = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return {**state, "cost": self._cost.copy()}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Go on from a state that `state_dict` gave.

        Raises:
            ValueError: if it is of another level or number of environments.
        """
        for simulation, part in zip(self.simulations, self._slices, strict=True):
            simulation.load_state_dict({name: array[part] for name, array in state.items()})
        self._cost = _rows(state.get("cost"), np.float64, self.num_envs, "cost").copy()
        self._started = True

    def _seed(self, seed: int | Sequence[int | None] | None, chosen: NDArray[np.bool_]) -> None:
        if seed is None and self._started:
            return
        seeds: list[int | None]
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, int | np.integer):
            seeds = [*spawn(int(seed), self.num_envs)]
        else:
            seeds = [None if number is None else operator.index(number) for number in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} numbers, expected one or {self.num_envs}")
        for simulation, part in zip(self.simulations, self._slices, strict=True):
            for row, (number, wanted) in enumerate(zip(seeds[part], chosen[part], strict=True)):
                if wanted and (number is not None or not self._started):
                    simulation.rngs[row] = seeding.np_random(number)[0]


def _rows(values: Any, dtype: Any, n: int, name: str) -> np.ndarray:
    array = np.asarray(values, dtype)
    if array.shape != (n,):
        raise ValueError(f"{name} has shape {array.shape}, expected {(n,)}")
    return array
