"""The closed loop: whole episodes, each to its end, whatever acts.

Export, calibration, evaluation, demo and benchmarks all drive their robots by `drive`; what they do with the
steps is theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Act = Callable[[npt.NDArray[Any], Any], npt.NDArray[Any]]
"""Observations (N, O) and the environments, in the states in which they were observed → actions (N, a)."""
SIDE_BY_SIDE = 100
"""Most robots simulated at once, unless a caller has its own number."""


@dataclass(frozen=True)
class Step:
    """One control step of N robots side by side; rows that are not running say nothing.

    Attributes:
        observation: (N, O) before the step.
        action: (N, a) what was sent.
        reward: (N,).
        cost: (N,) the task's own, whatever an algorithm constrains.
        after: (N, O) after the step: where it ended an episode, that episode's last.
        running: (N,) whose episode this step belongs to.
    """

    observation: npt.NDArray[Any]
    action: npt.NDArray[Any]
    reward: npt.NDArray[np.float64]
    cost: npt.NDArray[np.float64]
    after: npt.NDArray[Any]
    running: npt.NDArray[np.bool_]


def side_by_side(count: int, most: int = SIDE_BY_SIDE) -> int:
    """How many robots to simulate at once so that no group of the `count` episodes is much smaller."""
    return -(-count // -(-count // most))


def groups(count: int, size: int) -> list[slice]:
    """The episodes 0 to count − 1 in groups of `size`, the last one of what is left."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def drive(env: Any, act: Act, rows: Sequence[int], most: int | None = None) -> Iterator[Step]:
    """Drives one episode for each row to its end, all side by side.

    Args:
        env: a vector environment with autoreset in the same step. Where it has more rows than asked for,
            those to spare repeat episodes and never run.
        act: what drives.
        rows: seeds of the episodes, at most env.num_envs.
        most: longest an episode may last [steps]; None: as long as the environment lets it.

    Yields:
        The steps, until no episode is running.
    """
    spare = env.num_envs - len(rows)
    observation, _ = env.reset(seed=[*rows, *(rows[i % len(rows)] for i in range(spare))])
    running = np.arange(env.num_envs) < len(rows)
    count = 0
    while running.any() and count != most:
        action = act(observation, env)
        after, reward, terminated, truncated, info = env.step(action)
        last = after
        if "final_obs" in info:
            last = np.where(info["_final_obs"][:, None], info["final_obs"], after)
        # Where an algorithm constrains something else, the task's own cost stands beside it.
        yield Step(observation, action, reward, info.get("task_cost", info["cost"]), last, running.copy())
        running &= ~(terminated | truncated)
        observation, count = after, count + 1
