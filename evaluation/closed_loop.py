"""Episodes in simulation, many side by side, with whatever decides in the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, fields
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from decision import MEMORY, BatchDecider, Decisions, Memory, Mode, OpenedBy, Origin
from pointgoal import seeds
from pointgoal.loop import SIDE_BY_SIDE, Step, drive, groups, side_by_side
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
TextArray = NDArray[np.str_]

HazardSource = Literal["given", "lidar"]
"""What the filter knows of the hazards: their centres in the body frame, or the lidar alone."""
_TIMED_STATES = 1000
"""States of the episodes on which a decision is timed, at most."""


class TaskError(ValueError):
    """A task that is not there, or not one of point robots."""


@dataclass(frozen=True)
class Trajectory:
    """What E robots did, T steps long; after an episode's end numbers are NaN, texts empty.

    Attributes:
        pose: [T, E, 3] x, y [m] and heading [rad] before the step.
        goal: [T, E, 2] the goal then [m].
        action: [T, E, 2] what was sent.
        risk: [T, E] the risk score λ_ξ(s).
        mode: [T, E] texts of `Mode`.
        opened_by: [T, E] texts of `OpenedBy`, "" where the gate was closed.
        barrier: [T, E] h [m].
        cost: [T, E] the step's cost.
        reward: [T, E] the step's reward.
        hazards: [E, n, 2] the hazards' centres [m].
    """

    pose: FloatArray
    goal: FloatArray
    action: FloatArray
    risk: FloatArray
    mode: TextArray
    opened_by: TextArray
    barrier: FloatArray
    cost: FloatArray
    reward: FloatArray
    hazards: FloatArray


@dataclass(frozen=True)
class Episodes:
    """E finished episodes; what is counted is counted for each of them, [E].

    Attributes:
        returns: sums of rewards.
        costs: sums of costs: the depth cost, metres inside hazards.
        violating_steps: steps with a cost above 0: the indicator cost.
        steps: lengths.
        modes: mode → steps in it.
        origins: origin → steps on which the action sent was not the nominal one and came from there.
        opened_by: cause → steps on which it opened the gate; those of the barrier are its alone, for there
            the risk score was not above the threshold.
        certified_replaced: steps on which another action was sent though the nominal one had a certificate.
        seconds: decision times of one robot [s], see `timed`.
        reasons: why, once for each fallback.
        trajectory: what they did, if it was recorded.
    """

    returns: FloatArray
    costs: FloatArray
    violating_steps: IntArray
    steps: IntArray
    modes: dict[Mode, IntArray]
    origins: dict[Origin, IntArray]
    opened_by: dict[OpenedBy, IntArray]
    certified_replaced: IntArray
    seconds: list[float]
    reasons: list[str]
    trajectory: Trajectory | None = None

    @property
    def open_steps(self) -> IntArray:
        """[E] steps with the gate open."""
        return np.asarray(np.sum(list(self.opened_by.values()), axis=0))

    @property
    def interventions(self) -> IntArray:
        """[E] steps on which the action sent was not the nominal one."""
        return self.steps - self.modes[Mode.NOMINAL]


def run_episodes(
    task: str,
    decider: BatchDecider,
    episodes: int,
    seed: int = 0,
    hazards: HazardSource = "lidar",
    record: bool = False,
    progress: Callable[[int], None] | None = None,
    use: Use = Use.EVALUATION,
    first: int = 0,
) -> Episodes:
    """Runs episodes to their ends, up to `SIDE_BY_SIDE` at once; episode i has layout number first + i.

    Args:
        task: gymnasium id of the task.
        decider: what decides.
        episodes: how many, at least 1.
        seed: of the layouts; another one has none of them in common.
        hazards: what the filter knows of the hazards.
        record: whether to keep the trajectory; then all of them must fit side by side.
        progress: called with the count of steps that were made since the last call.
        use: what for; together with the seed it says which layouts.
        first: how many layouts of that use and seed to leave to others.

    Raises:
        ValueError: if there is no episode to run, or too many to record.
        TaskError: if there is no such task.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if record and episodes > SIDE_BY_SIDE:
        raise ValueError(f"at most {SIDE_BY_SIDE} episodes can be recorded, got {episodes}")
    rows, rng = seeds.rows(use, seed, first + episodes)[first:], seeds.generator(use, seed)
    tally, recording = _Tally(episodes), _Recording() if record else None
    states: list[_State] = []
    size = side_by_side(episodes, SIDE_BY_SIDE)
    with closing(_make(task, size)) as env:
        for part in groups(episodes, size):
            robots = _Robots(decider, hazards, size, recording)
            for step in drive(env, robots.act, rows[part]):
                live = np.flatnonzero(step.running)
                tally.add(part.start + live, live, step, robots.decisions)
                states.append(robots.state(step.observation, int(rng.choice(live))))
                if recording is not None:
                    recording.after(step)
                if progress is not None:
                    progress(len(live))
    chosen = rng.choice(len(states), min(len(states), _TIMED_STATES), replace=False)
    tally.seconds = list(timed(decider, (states[i] for i in chosen)))
    return tally.episodes(None if recording is None else recording.trajectory())


@dataclass(frozen=True)
class _State:
    """What one robot decided on: observation (O,), hazards (n, 2) or None, memory."""

    observation: FloatArray
    hazards: FloatArray | None
    memory: np.void


def timed(decider: BatchDecider, states: Iterator[_State]) -> Iterator[float]:
    """How long a decision takes [s]: `decide` as one robot calls it, on one state after the other.

    The first state is decided once before, untimed: a connection may have to be opened. Through a service
    this is the whole round trip.
    """
    for i, state in enumerate(states):
        if i == 0:
            decider.decide(state.observation, state.hazards, state.memory)
        started = time.perf_counter()
        decider.decide(state.observation, state.hazards, state.memory)
        yield time.perf_counter() - started


def _make(task: str, count: int) -> PointGoalVectorEnv:
    try:
        env = gymnasium.make_vec(task, num_envs=count).unwrapped
    except gymnasium.error.Error as error:
        raise TaskError(f"task {task!r}: {error}") from error
    if not isinstance(env, PointGoalVectorEnv):
        raise TaskError(f"task {task!r} is not a PointGoal task")
    return env


class _Robots:
    """N robots from their episodes' starts on: asks what decides, and carries the memory."""

    decisions: Decisions

    def __init__(
        self, decider: BatchDecider, source: HazardSource, count: int, recording: _Recording | None
    ) -> None:
        self._decider = decider
        self._source = source
        self._recording = recording
        self._hazards: FloatArray | None = None
        self._before: Memory = np.zeros(count, MEMORY)
        self._memory = self._before

    def act(self, observation: FloatArray, env: Any) -> FloatArray:
        self._hazards = env.hazards_in_body_frame() if self._source == "given" else None
        self._before = self._memory
        self.decisions = self._decider.decide_batch(observation, self._hazards, self._before)
        self._memory = self.decisions.memory
        if self._recording is not None:
            self._recording.before(env, self.decisions)
        return self.decisions.action

    def state(self, observation: FloatArray, robot: int) -> _State:
        """What a robot decided on in the last step."""
        hazards = None if self._hazards is None else self._hazards[robot].copy()
        return _State(observation[robot].copy(), hazards, self._before[robot].copy())


class _Tally:
    """Adds up what happens in E episodes."""

    def __init__(self, count: int) -> None:
        def zeros() -> IntArray:
            return np.zeros(count, np.int64)

        self._returns, self._costs = np.zeros(count), np.zeros(count)
        self._violating, self._steps, self._replaced = zeros(), zeros(), zeros()
        self._modes = {mode: zeros() for mode in Mode}
        self._origins = {origin: zeros() for origin in Origin}
        self._opened_by = {cause: zeros() for cause in OpenedBy}
        self._reasons: list[str] = []
        self.seconds: list[float] = []

    def add(self, episodes: IntArray, rows: IntArray, step: Step, decisions: Decisions) -> None:
        """Adds one step of the robots in some rows, whose episodes have these numbers."""
        mode, changed = decisions.mode[rows], decisions.mode[rows] != Mode.NOMINAL
        self._returns[episodes] += step.reward[rows]
        self._costs[episodes] += step.cost[rows]
        self._violating[episodes] += step.cost[rows] > 0.0
        self._steps[episodes] += 1
        self._replaced[episodes] += decisions.certified[rows] & changed
        for kind, count in self._modes.items():
            count[episodes] += mode == kind
        for origin, count in self._origins.items():
            count[episodes] += changed & (decisions.origin[rows] == origin)
        for cause, count in self._opened_by.items():
            count[episodes] += decisions.opened_by[rows] == cause
        self._reasons += [decisions.reason[i] or "unknown" for i in rows[mode == Mode.FALLBACK]]

    def episodes(self, trajectory: Trajectory | None) -> Episodes:
        """The finished episodes."""
        return Episodes(
            returns=self._returns,
            costs=self._costs,
            violating_steps=self._violating,
            steps=self._steps,
            modes=self._modes,
            origins=self._origins,
            opened_by=self._opened_by,
            certified_replaced=self._replaced,
            seconds=self.seconds,
            reasons=self._reasons,
            trajectory=trajectory,
        )


class _Recording:
    """Keeps what the robots do, step by step."""

    def __init__(self) -> None:
        self._columns: dict[str, list[NDArray[Any]]] = {
            field.name: [] for field in fields(Trajectory) if field.name != "hazards"
        }
        self._hazards: FloatArray | None = None

    def before(self, env: PointGoalVectorEnv, decisions: Decisions) -> None:
        """Keeps the state before a step, and what was decided."""
        if self._hazards is None:
            self._hazards = env.hazards.copy()
        self._columns["pose"].append(env.pose)
        self._columns["goal"].append(env.goal.copy())
        for name in ("action", "risk", "mode", "opened_by", "barrier"):
            self._columns[name].append(np.array(getattr(decisions, name)))

    def after(self, step: Step) -> None:
        """Keeps what came of the step, and blanks the rows whose episode was over."""
        self._columns["cost"].append(step.cost.copy())
        self._columns["reward"].append(step.reward.copy())
        for column in self._columns.values():
            row = column[-1]
            row[~step.running] = "" if row.dtype.kind == "U" else np.nan

    def trajectory(self) -> Trajectory:
        """The recording."""
        if self._hazards is None:
            raise ValueError("nothing was recorded")
        arrays = {name: np.array(rows) for name, rows in self._columns.items()}
        return Trajectory(**arrays, hazards=self._hazards)
