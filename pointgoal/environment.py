"""One point robot, as a gymnasium environment."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np

from pointgoal.observation import FloatArray, layout
from pointgoal.rendering import draw
from pointgoal.simulation import EPISODE_STEPS, CostKind, Simulation, State
from pointgoal.vector import action_space, observation_space

_ROW = np.array([0])


class PointGoalEnv(gymnasium.Env[FloatArray, FloatArray]):
    """Drive a point robot from goal to goal among hazards.

    The observation has 28 numbers at level 0 and 60 above (`pointgoal.observation.layout`); the action is
    thrust and turning in ±1; ``info["cost"]`` is the cost of the step. An episode is truncated after 1,000
    steps of 0.02 s and terminates only if a new goal cannot be placed.

    Args:
        level: 0, 1 or 2.
        cost: ``"depth"``, metres inside hazards (the paper's), or ``"indicator"``, 1 if that is above 0.
        render_mode: ``"rgb_array"`` or None.
        max_episode_steps: steps after which an episode is truncated; None: never.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        level: int = 1,
        cost: CostKind = "depth",
        render_mode: str | None = None,
        max_episode_steps: int | None = EPISODE_STEPS,
    ) -> None:
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1, got {max_episode_steps}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.level = level
        self.render_mode = render_mode
        self.layout = layout(level)
        self.observation_space = observation_space(self.layout)
        self.action_space = action_space()
        self.simulation = Simulation(level, 1, cost, episode_steps=max_episode_steps)
        self._cost = 0.0
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: of the generator that draws layouts and goals.
            options: ``"state"``: an exact state (pose, velocity, goal, hazards, vase_qpos, vase_qvel).

        Returns:
            (size,) the observation, and an info with zero cost.

        Raises:
            ValueError: naming the option that is wrong.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        state = options.pop("state", None)
        if options:
            raise ValueError(f"reset has no options {sorted(options)}; it takes ['state']")
        self.simulation.rngs = [self.np_random]
        if state is None:
            self.simulation.reset(_ROW)
        else:
            rows = {name: np.asarray(value)[None] for name, value in state.items()}
            self.simulation.set_state(_ROW, State.from_mapping(rows, self.level, 1))
        self._cost, self._running = 0.0, True
        return self.simulation.observe()[0], {"cost": 0.0}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Advance by 0.02 s with an action (2,), clipped to ±1.

        Raises:
            ValueError: if the action's shape is wrong or it is not finite.
            RuntimeError: before the first reset, or after the episode's end.
        """
        if not self._running:
            raise RuntimeError("step was called before reset, or after the episode ended")
        action = np.asarray(action, np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"the action must be 2 finite numbers, got {action!r}")
        result = self.simulation.step(action[None])
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        self._cost, self._running = float(result.cost[0]), not (terminated or truncated)
        return result.observation[0], float(result.reward[0]), terminated, truncated, {"cost": self._cost}

    def render(self) -> np.ndarray | None:
        """A picture (height, width, 3) uint8 of the present state, or None without a render mode."""
        return None if self.render_mode is None else draw(self.simulation, 0, self._cost)

    def hazards_in_body_frame(self) -> FloatArray:
        """(h, 2) centres of the hazards: x ahead of the robot, y to its left [m]."""
        return _first(self.simulation.hazards_in_body_frame())

    @property
    def pose(self) -> FloatArray:
        """(3,) x, y [m], heading [rad] in the world."""
        return _first(self.simulation.pose)

    @property
    def velocity(self) -> FloatArray:
        """(3,) vx, vy [m/s] in the world, yaw rate [rad/s]."""
        return _first(self.simulation.velocity)

    @property
    def goal(self) -> FloatArray:
        """(2,) centre of the goal [m]."""
        return _first(self.simulation.goal)

    @property
    def hazards(self) -> FloatArray:
        """(h, 2) centres of the hazards [m]."""
        return _first(self.simulation.hazards)

    @property
    def elapsed_steps(self) -> int:
        """Steps since the episode's start."""
        return int(self.simulation.elapsed_steps[0])

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        # One generator draws both for gymnasium and for the simulation.
        self.np_random = self.simulation.rngs[0]

    def __copy__(self) -> PointGoalEnv:
        """As `copy.deepcopy`: two environments that share a simulation would drive one robot."""
        return copy.deepcopy(self)


def unlimited(**settings: Any) -> PointGoalEnv:
    """A `PointGoalEnv` that truncates nothing: gymnasium's own wrapper does, after ``max_episode_steps``."""
    return PointGoalEnv(**settings, max_episode_steps=None)


def _first(rows: FloatArray) -> FloatArray:
    row: FloatArray = rows[0]
    return row
