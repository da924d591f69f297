"""Training speed end to end: steps a second, where the time goes, memory, and the time to a return of 25."""

from __future__ import annotations

import os
import resource
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.simulation import Settings as SimulationSettings
from benchmarks.simulation import measure
from trainer.config import AlgorithmName, Config
from trainer.train import Summary, train

OMNISAFE = 243.0
"""Steps a second of OmniSafe 0.5.0's PPO-Lag on PointGoal1, its defaults, one environment, two cores."""
GOAL = 25.0
"""The mean return of the last 100 episodes whose time is measured."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    algorithm: AlgorithmName = "lagnet"
    """Algorithm whose steps a second are measured, with its default settings at level 1."""
    steps: int = 400_000
    """Environment steps of each repetition."""
    repeats: int = 3
    """Repetitions; the median is printed."""
    seeds: int = 0
    """Seeds for PPO's time to a return of 25; 0 leaves it out."""
    learning_steps: int = 1_200_000
    """Environment steps of each of those runs; the time counts from the first one."""


def run(algorithm: AlgorithmName, steps: int, seed: int) -> Summary:
    """One run with default settings in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        return train(Config(algorithm=algorithm, total_steps=steps, seed=seed, out=Path(folder) / "run"))


def seconds_to_goal(summary: Summary) -> float:
    """Wall time until the mean return of the last 100 episodes reached the goal [s]; infinite if never."""
    return next((t for t, value in summary.trace if value is not None and value >= GOAL), float("inf"))


def main() -> None:
    """Print the tables."""
    settings = tyro.cli(Settings, description=__doc__)
    console = Console()
    config = Config()
    console.print(
        f"{os.cpu_count()} CPUs, torch {torch.__version__}, {settings.algorithm}, level 1, defaults"
    )
    runs = [run(settings.algorithm, settings.steps, seed) for seed in range(settings.repeats)]
    rates = [summary.steps / summary.seconds["total"] for summary in runs]
    summary = runs[rates.index(sorted(rates)[len(rates) // 2])]
    rate = summary.steps / summary.seconds["total"]
    physics = measure(1, config.num_envs, config.threads, SimulationSettings(repeats=3)).physics
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2

    table = Table("figure", "value")
    table.columns[1].justify = "right"
    table.add_row("steps/s, end to end", f"{rate:,.0f}")
    table.add_row("  lowest and highest", f"{min(rates):,.0f} to {max(rates):,.0f}")
    seconds = summary.seconds
    update = seconds["total"] - seconds["simulation"] - seconds["inference"]
    for name, part in (
        ("simulation", seconds["simulation"]),
        ("inference", seconds["inference"]),
        ("update", update),
    ):
        table.add_row(
            f"  {name} [µs a step]", f"{1e6 * part / summary.steps:.1f} ({part / seconds['total']:.0%})"
        )
    table.add_row("bare physics, steps/s", f"{physics:,.0f}")
    table.add_row("end to end over bare physics", f"{rate / physics:.2f}")
    table.add_row("end to end over OmniSafe", f"{rate / OMNISAFE:.0f}")
    table.add_row("peak memory [GB]", f"{memory:.2f}")
    console.print(table)

    if settings.seeds:
        times = [seconds_to_goal(run("ppo", settings.learning_steps, seed)) for seed in range(settings.seeds)]
        listed = ", ".join(f"{t:.0f}" for t in times)
        console.print(f"PPO to a return of {GOAL:.0f}: median {median(times):.0f} s ({listed})")


if __name__ == "__main__":
    main()
