"""What a sweep consists of: its settings, and the runs that they stand for."""

import dataclasses
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import get_args

from tyro.conf import Suppress

from trainer import checkpoint
from trainer.config import FILE as CONFIG
from trainer.config import AlgorithmName, Config, check
from trainer.errors import ConfigError

FOLDER = ".sweep"
"""Folder beside the runs, for what the sweep itself keeps there."""


@dataclass(frozen=True, kw_only=True)
class Sweep(Config):
    """Trains every combination of algorithms, cost limits and seeds, many at a time, on Ray.

    For example: lagnet-sweep --algorithms lagnet ppo-lag --cost-limits 0.5 2.0 --seeds 0 1 --out runs/sweep

    Runs on the cores of this machine, or on the Ray cluster at --address. The same command again goes on
    where it was stopped: a finished run is not run again, any other continues from its last checkpoint. On a
    cluster, --out must lie on storage that every node, and the machine where this is typed, sees at the same
    path; every node needs the same lagnet. Every other flag of lagnet-train applies to each of the runs.
    """

    algorithms: tuple[AlgorithmName, ...] = get_args(AlgorithmName)
    """Learning algorithms, as in lagnet-train."""
    cost_limits: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    """Cost limits d on the undiscounted cost of an episode."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds. Runs start seed by seed, so that the first seed's comparison is there first."""
    out: Path = field()
    """Folder of the sweep. Each run gets the folder ALGORITHM-dLIMIT-sSEED in it; summary.csv comes last."""
    address: str | None = None
    """Ray cluster: ray://HOST:10001, or HOST:6379 on a machine of it. Left out: this machine alone."""
    cores: int | None = None
    """Cores of this machine to use, all of them if left out. A cluster's are set where it is started."""
    threads: int = 1
    """Threads of each run, for physics and for torch; each takes one core."""
    retries: int = 3
    """How often a run may lose its worker without getting any further, before it is given up."""

    algorithm: Suppress[AlgorithmName] = "lagnet"
    cost_limit: Suppress[float] = 1.0
    seed: Suppress[int] = 0
    resume: Suppress[Path | None] = None


@dataclass(frozen=True)
class SweptRun:
    """One run of a sweep.

    Attributes:
        name: of its folder, which says what it is.
        config: its settings, its folder among them.
        folder: an absolute path.
    """

    name: str
    config: Config
    folder: Path

    @property
    def claim(self) -> Path:
        """The file that the worker which trains this run holds locked."""
        return self.folder.parent / FOLDER / self.name


def plan(settings: Sweep) -> list[SweptRun]:
    """The runs of a sweep, in the order in which they start.

    Raises:
        ConfigError: if a setting is at fault.
    """
    for name in ("algorithms", "cost_limits", "seeds"):
        if not getattr(settings, name):
            raise ConfigError(f"--{name.replace('_', '-')} must name at least one")
    if settings.cores is not None and settings.address is not None:
        raise ConfigError("--cores is for this machine alone; leave it out beside --address")
    if settings.cores is not None and settings.cores < settings.threads:
        raise ConfigError(f"--cores ({settings.cores}) must be at least --threads ({settings.threads})")
    if settings.retries < 0:
        raise ConfigError(f"--retries must not be negative, not {settings.retries}")
    shared = {each.name: getattr(settings, each.name) for each in dataclasses.fields(Config)}
    root = settings.out.resolve()
    runs: dict[str, SweptRun] = {}
    for seed, algorithm, limit in product(settings.seeds, settings.algorithms, settings.cost_limits):
        name = f"{algorithm}-d{float(limit)}-s{seed}"
        own = {"algorithm": algorithm, "cost_limit": float(limit), "seed": seed, "out": root / name}
        config = Config(**shared | own | {"resume": None})
        check(config)
        runs[name] = SweptRun(name, config, root / name)
    return list(runs.values())


def refuse_other_settings(run: SweptRun) -> None:
    """Makes sure that a run which is there already was started with these settings.

    Raises:
        ConfigError: if it was started with others.
        CheckpointError: if its settings cannot be read.
    """
    if not (run.folder / CONFIG).exists():
        return
    from trainer.train import load_config  # with torch, which a sweep that begins does without

    there = load_config(run.folder)
    for each in dataclasses.fields(Config):
        old, new = getattr(there, each.name), getattr(run.config, each.name)
        if each.name not in {"out", "resume"} and old != new:
            raise ConfigError(
                f"{run.folder} was started with {each.name} {old}, not {new}: give the same settings, "
                "or another --out"
            )


def is_finished(run: SweptRun) -> bool:
    """Whether the run's checkpoint is that of its last epoch.

    Raises:
        CheckpointError: if the checkpoint cannot be read.
    """
    if not (run.folder / checkpoint.FILE).exists():
        return False
    _, facts = checkpoint.read(run.folder)
    return int(facts["epoch"]) >= run.config.epochs
