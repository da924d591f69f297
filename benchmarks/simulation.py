"""Steps a second of the vector environment, against bare `mujoco.batch` stepping of the same scene.

Both step the same scenes with the same random actions, turn and turn about in one run; the environment adds
lidar, reward, cost, goals, and resets (episodes are staggered, so that some end in every stretch).
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from statistics import median

import mujoco
import numpy as np
import tyro
from mujoco.batch import Batch
from rich.console import Console
from rich.table import Table

from pointgoal import seeds
from pointgoal.scene import PHYSICS_STEPS
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS
from pointgoal.vector import PointGoalVectorEnv


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    num_envs: tuple[int, ...] = (32, 128, 512)
    """Numbers of environments to measure level 1 with; the largest stands for every level."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads to measure with; the largest stands for every level."""
    repeats: int = 9
    """Stretches measured for each figure; the median is printed."""
    steps: int = 40_000
    """Environment steps in one stretch."""


@dataclass(frozen=True)
class Rates:
    """Environment steps a second, medians over the stretches."""

    environment: float
    physics: float
    ratio: float


def measure(level: int, num_envs: int, threads: int, settings: Settings) -> Rates:
    """Measure one combination; the ratio is the median over pairs of neighbouring stretches."""
    env = PointGoalVectorEnv(level=level, num_envs=num_envs, num_threads=threads)
    elapsed = np.linspace(0, EPISODE_STEPS - 1, num_envs).astype(int)
    env.reset(seed=seeds.rows(Use.SIMULATION_SPEED, 0, num_envs), options={"elapsed_steps": elapsed})
    batch = Batch(env.simulations[0].model, num_envs, nthread=threads, persistent=True)
    control = batch.bind("ctrl")
    batch.bind("sensordata")
    batch.state[...] = np.concatenate([simulation.batch.state for simulation in env.simulations])
    count = max(1, settings.steps // num_envs)
    actions = seeds.generator(Use.SIMULATION_SPEED, 0).uniform(-1, 1, (count, num_envs, 2))

    def environment_stretch() -> float:
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        return count * num_envs / (time.perf_counter() - start)

    def physics_stretch() -> float:
        start = time.perf_counter()
        for action in actions:
            control[...] = action
            batch.step(nstep=PHYSICS_STEPS, stage=mujoco.mjtStage.mjSTAGE_ACC)
        return count * num_envs / (time.perf_counter() - start)

    environment_stretch(), physics_stretch()
    pairs = [(environment_stretch(), physics_stretch()) for _ in range(settings.repeats)]
    env.close()
    environment, physics = zip(*pairs, strict=True)
    return Rates(median(environment), median(physics), median(e / p for e, p in pairs))


def main() -> None:
    """Print the tables."""
    settings = tyro.cli(Settings, description=__doc__)
    console = Console()
    console.print(
        f"{os.cpu_count()} CPUs, MuJoCo {mujoco.__version__}, medians of {settings.repeats} stretches"
    )
    console.print(
        f"Reference: bare mujoco.batch, {PHYSICS_STEPS} physics steps and the sensors, same scene and run.\n"
    )
    combinations = [(level, max(settings.num_envs), max(settings.threads)) for level in (0, 1, 2)]
    for num_envs in settings.num_envs:
        combinations += [(1, num_envs, threads) for threads in settings.threads]
    table = Table("level", "environments", "threads", "steps/s", "bare physics/s", "ratio")
    for level, num_envs, threads in dict.fromkeys(combinations):
        rates = measure(level, num_envs, threads, settings)
        figures = (f"{rates.environment:,.0f}", f"{rates.physics:,.0f}", f"{rates.ratio:.2f}")
        table.add_row(str(level), str(num_envs), str(threads), *figures)
    for column in table.columns:
        column.justify = "right"
    console.print(table)


if __name__ == "__main__":
    main()
