"""Faults at speed: ``python -m benchmarks.faults``.

A reward-only policy drives; every 50 steps or so, at random, each robot meets one of three faults: its
networks give NaN, its filter raises, or its replies are lost for 1 to 10 steps. Prints what became of them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray

from decision import MEMORY, Decisions, Memory, next_of_plan
from filter import BarrierFilter, FilterConfig, Scene
from guide import DEFAULT_STRENGTH, Guide
from inference import Networks
from models import Bundle
from monitor import Monitor
from pointgoal import seeds
from pointgoal.loop import drive
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv

FloatArray = NDArray[np.float64]
EVERY = 50
"""Steps between two faults of a robot, on average."""
LONGEST = 10
"""Most replies that are lost in a row."""
_VASES = 44
"""Where an observation's vases start: nothing reads the first, so that it can carry a mark."""
_NAN, _RAISE = 0.125, 0.25


@dataclass
class Arguments:
    """What to run."""

    bundle: Path = Path("models/ppo1")
    """Folder of the policy's bundle."""
    episodes: int = 200
    """How many episodes."""
    gate: Literal["always", "floor"] = "always"
    """When the filter is active; floor: where the barrier is low and never else."""
    hazards: Literal["given", "lidar"] = "given"
    """Where the filter has the hazards from."""
    seed: int = 100
    """Seed of the layouts and of the faults."""


class FaultyNetworks(Networks):
    """Gives NaN for marked observations."""

    def run(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The networks' answers, but for the marked ones."""
        action, risk = super().run(np.where(np.arange(observation.shape[1]) == _VASES, 0.0, observation))
        action[observation[:, _VASES] == _NAN] = np.nan
        return action, np.zeros_like(risk)


class FaultyFilter(BarrierFilter):
    """Raises on marked observations."""

    def decide(
        self, view: Scene, nominal: FloatArray, memory: Memory, active: NDArray[np.bool_]
    ) -> Decisions:
        """The filter's decisions, unless one is marked."""
        if (view.observation[:, _VASES] == _RAISE).any():
            raise ArithmeticError("a fault made on purpose")
        return super().decide(view, nominal, memory, active)


def run(arguments: Arguments) -> tuple[FloatArray, NDArray[np.int64], Counter[str]]:
    """Returns (E,), violating steps (E,), and how many faults of each kind there were."""
    n = arguments.episodes
    bundle = Bundle.load(arguments.bundle)
    robot_filter = FaultyFilter(FilterConfig(), Guide(strength=DEFAULT_STRENGTH))
    gate: Literal["always", "risk"] = "always" if arguments.gate == "always" else "risk"
    monitor = Monitor(bundle, FaultyNetworks(bundle), robot_filter, gate, threshold=1e9)
    rng = seeds.generator(Use.FILTER, arguments.seed)
    memory, lost = np.zeros(n, MEMORY), np.zeros(n, np.int64)
    faults: Counter[str] = Counter()

    def act(observation: ArrayLike, env: Any) -> FloatArray:
        nonlocal memory, lost
        seen = np.array(observation)
        kind = np.where(rng.random(n) < 1.0 / EVERY, rng.integers(1, 4, n), 0)
        kind[lost > 0] = 0
        seen[kind == 1, _VASES], seen[kind == 2, _VASES] = _NAN, _RAISE
        lost = np.where(kind == 3, rng.integers(1, LONGEST + 1, n), lost)
        faults.update(("networks", "filter", "reply")[k - 1] for k in kind if k)
        action, after = next_of_plan(memory)
        asked = np.flatnonzero(lost == 0)
        hazards = env.hazards_in_body_frame()[asked] if arguments.hazards == "given" else None
        decided = monitor.decide_batch(seen[asked], hazards, memory[asked])
        action[asked], after[asked] = decided.action, decided.memory
        memory, lost = after, np.maximum(lost - 1, 0)
        return action

    env = PointGoalVectorEnv(level=1, num_envs=n, num_threads=2)
    returns, violations = np.zeros(n), np.zeros(n, np.int64)
    for step in drive(env, act, seeds.rows(Use.FILTER, arguments.seed, n)):
        returns += step.reward * step.running
        violations += (step.cost > 0.0) & step.running
    env.close()
    return returns, violations, faults


def main() -> None:
    """Print what became of the robots."""
    arguments = tyro.cli(Arguments)
    returns, violations, faults = run(arguments)
    print(
        f"{len(returns)} episodes, gate {arguments.gate}, hazards {arguments.hazards}: return "
        f"{returns.mean():.2f}, violating steps {violations.sum()} in {(violations > 0).sum()} episodes; "
        f"faults: {dict(faults)}"
    )


if __name__ == "__main__":
    main()
