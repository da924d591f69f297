"""Episodes in simulation, many side by side, with a decider in the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from evaluation.deciders import Decided, Decider, FloatArray
from filter import Mode
from pointgoal import seeds
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv

HazardSource = Literal["given", "lidar"]
"""What the filter knows of the hazards: their centres in the body frame, or the lidar alone."""
SIDE_BY_SIDE = 100
"""Most robots simulated at once."""
_TIMED_STATES = 1000
"""States of the episodes on which a decision is timed."""


class TaskError(ValueError):
    """A task that is not there, or not one of point robots."""


@dataclass(frozen=True)
class Trajectory:
    """What the robots did, [T, E] for T steps of E episodes; rows after an episode's end hold NaN.

    Attributes:
        pose: [T, E, 3] x, y [m] and heading [rad] before the step.
        goal: [T, E, 2] the goal then [m].
        action: [T, E, 2] what was sent.
        risk: [T, E] the risk score λ_ξ(s).
        mode: [T, E] of `filter.Mode`, NaN after the end.
        barrier: [T, E] h [m].
        cost: [T, E] the step's cost.
        reward: [T, E] the step's reward.
        hazards: [E, n, 2] the hazards' centres [m].
    """

    pose: FloatArray
    goal: FloatArray
    action: FloatArray
    risk: FloatArray
    mode: FloatArray
    barrier: FloatArray
    cost: FloatArray
    reward: FloatArray
    hazards: FloatArray


@dataclass(frozen=True)
class Episodes:
    """E finished episodes.

    Attributes:
        returns: [E] sums of rewards.
        costs: [E] sums of costs.
        violating_steps: [E] steps with a cost above 0.
        steps: [E] lengths.
        modes: [E, 3] steps in each of `filter.Mode`.
        seconds: decision times of one robot [s].
        reasons: why, once for each fallback.
        trajectory: what they did, if it was recorded.
    """

    returns: FloatArray
    costs: FloatArray
    violating_steps: NDArray[np.int64]
    steps: NDArray[np.int64]
    modes: NDArray[np.int64]
    seconds: list[float]
    reasons: list[str]
    trajectory: Trajectory | None = None


def run_episodes(
    task: str,
    decider: Decider,
    episodes: int,
    seed: int = 0,
    hazards: HazardSource = "given",
    record: bool = False,
    progress: Callable[[int], None] | None = None,
    use: Use = Use.EVALUATION,
) -> Episodes:
    """Runs episodes to their ends, up to `SIDE_BY_SIDE` at once; episode i takes `seeds.rows` number i.

    Args:
        task: gymnasium id of the task.
        decider: who decides.
        episodes: how many, at least 1.
        seed: of the layouts; another one has none of them in common.
        hazards: what the filter knows of the hazards.
        record: whether to keep the trajectory; then all of them must fit side by side.
        progress: called with the count of steps that all robots made since the last call.
        use: what for; together with the seed it says which layouts.

    Raises:
        ValueError: if there is no episode to run, or too many to record.
        TaskError: if there is no such task.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if record and episodes > SIDE_BY_SIDE:
        raise ValueError(f"at most {SIDE_BY_SIDE} episodes can be recorded, got {episodes}")
    rows, rng = seeds.rows(use, seed, episodes), seeds.generator(use, seed)
    parts = [
        _run(task, decider, rows[first : first + SIDE_BY_SIDE], rng, hazards, record, progress)
        for first in range(0, episodes, SIDE_BY_SIDE)
    ]
    return Episodes(
        returns=np.concatenate([part.returns for part in parts]),
        costs=np.concatenate([part.costs for part in parts]),
        violating_steps=np.concatenate([part.violating_steps for part in parts]),
        steps=np.concatenate([part.steps for part in parts]),
        modes=np.concatenate([part.modes for part in parts]),
        seconds=[second for part in parts for second in part.seconds],
        reasons=[reason for part in parts for reason in part.reasons],
        trajectory=parts[0].trajectory,
    )


def _run(
    task: str,
    decider: Decider,
    rows: list[int],
    rng: np.random.Generator,
    hazards: HazardSource,
    record: bool,
    progress: Callable[[int], None] | None,
) -> Episodes:
    count = len(rows)
    env = _make(task, count)
    try:
        tally = _Tally(env, count, record, rng)
        decider.start(count)
        observation, _ = env.reset(seed=rows)
        while tally.running.any():
            given = env.hazards_in_body_frame() if hazards == "given" else None
            decided = decider.decide(observation, given)
            tally.before(observation, given, decided)
            observation, reward, terminated, truncated, info = env.step(decided.action)
            tally.after(reward, info["cost"], terminated | truncated)
            if progress is not None:
                progress(count)
        seconds = decider.seconds(*tally.timed_states())
        return replace(tally.episodes(), seconds=seconds)
    finally:
        env.close()


def _make(task: str, count: int) -> PointGoalVectorEnv:
    try:
        env = gymnasium.make_vec(task, num_envs=count).unwrapped
    except gymnasium.error.Error as error:
        raise TaskError(f"task {task!r}: {error}") from error
    if not isinstance(env, PointGoalVectorEnv):
        raise TaskError(f"task {task!r} is not a PointGoal task")
    return env


class _Tally:
    """Adds up what happens to robots whose episode is still running."""

    def __init__(self, env: PointGoalVectorEnv, count: int, record: bool, rng: np.random.Generator) -> None:
        self.running = np.ones(count, np.bool_)
        self._env = env
        self._rng = rng
        self._sums = np.zeros((count, 2))
        self._counts = np.zeros((count, 2), np.int64)
        self._modes = np.zeros((count, len(Mode)), np.int64)
        self._reasons: list[str] = []
        self._states: list[tuple[FloatArray, FloatArray | None]] = []
        self._record: list[FloatArray] | None = [] if record else None
        self._hazards: FloatArray | None = None

    def before(self, observation: FloatArray, given: FloatArray | None, decided: Decided) -> None:
        """Notes the state in which the robots decided, and what."""
        rows = np.arange(len(self.running))
        self._modes[rows, decided.mode] += self.running
        for i in np.flatnonzero((decided.mode == Mode.FALLBACK) & self.running):
            self._reasons.append(decided.reason[i] or "unknown")
        chosen = self._rng.choice(np.flatnonzero(self.running))
        self._states.append((observation[chosen].copy(), None if given is None else given[chosen].copy()))
        if self._record is not None:
            if self._hazards is None:
                self._hazards = self._env.hazards.copy()
            columns: list[NDArray[Any]] = [
                self._env.pose,
                self._env.goal,
                decided.action,
                decided.risk,
                decided.mode,
                decided.barrier,
            ]
            self._record.append(np.column_stack(columns).astype(np.float64))

    def after(self, reward: FloatArray, cost: FloatArray, done: NDArray[np.bool_]) -> None:
        """Adds a step's reward and cost, and ends the episodes that are done."""
        self._sums += np.column_stack([reward, cost]) * self.running[:, None]
        self._counts += np.column_stack([cost > 0.0, np.ones_like(done)]) & self.running[:, None]
        if self._record is not None:
            row = np.column_stack([self._record[-1], cost, reward])
            row[~self.running] = np.nan
            self._record[-1] = row
        self.running &= ~done

    def timed_states(self) -> tuple[FloatArray, FloatArray | None]:
        """States that the robots were in: observations [K, O] and hazards [K, n, 2] or None."""
        states = self._states[:_TIMED_STATES]
        hazards = [given for _, given in states if given is not None]
        return np.array([observation for observation, _ in states]), np.array(hazards) if hazards else None

    def episodes(self) -> Episodes:
        """The finished episodes."""
        return Episodes(
            returns=self._sums[:, 0],
            costs=self._sums[:, 1],
            violating_steps=self._counts[:, 0],
            steps=self._counts[:, 1],
            modes=self._modes,
            seconds=[],
            reasons=self._reasons,
            trajectory=self._trajectory(),
        )

    def _trajectory(self) -> Trajectory | None:
        if self._record is None or self._hazards is None:
            return None
        every = np.array(self._record)
        return Trajectory(
            pose=every[..., 0:3],
            goal=every[..., 3:5],
            action=every[..., 5:7],
            risk=every[..., 7],
            mode=every[..., 8],
            barrier=every[..., 9],
            cost=every[..., 10],
            reward=every[..., 11],
            hazards=self._hazards,
        )
