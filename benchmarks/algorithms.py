"""All algorithms side by side: return and cost of the last training episodes, and of deterministic ones.

    lagnet-sweep --total-steps 5_000_000 --out runs/level1
    python -m benchmarks.algorithms runs/level1

Every finished run in the folders given that is not on record yet is evaluated, and put on record: a row of
runs.csv, and its learning curve, thinned, for lagnet-plot. The tables are made of the record alone, so runs
may come from several machines.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from pointgoal.seeds import Use
from trainer import checkpoint
from trainer.config import FILE as CONFIG
from trainer.config import Config
from trainer.curves import closing, read_progress
from trainer.plot import UNLIMITED
from trainer.report import FILE as PROGRESS
from trainer.report import TAIL

RECORD = Path(__file__).parent / "results"
RUNS = "runs.csv"
CURVE = ("steps", "episodes_ended", "return", "cost", "return_100", "cost_100", "multiplier")
"""Columns of progress.csv that are kept of a run's learning curve."""
EVERY = 5
"""Every how-many-th epoch of it is kept."""
OPERATION = frozenset(
    {"algorithm", "cost_limit", "seed", "out", "resume", "total_steps", "threads", "checkpoint_every"}
    | {"tensorboard", "task"}
)
"""Fields of a run's settings that do not say how it learns."""


@dataclass(frozen=True)
class Comparison:
    """Evaluates finished runs, adds them to the record, and prints the tables of the whole record."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of sweeps, each with its runs in it."""
    record: Path = RECORD
    """Folder of the record."""
    episodes: int = 200
    """Deterministic evaluation episodes of each run."""
    processes: int = 2
    """Runs that are evaluated at the same time."""
    markdown: bool = False
    """Print the tables as Markdown."""


@dataclass(frozen=True)
class Result:
    """What one run came to. Costs and returns are undiscounted means over episodes.

    Attributes:
        sweep: name of the folder that the run lies in.
        algorithm: its name.
        settings: where it differs from the defaults, "field=value" with blanks between.
        cost_limit: d.
        seed: of the run.
        steps: environment steps of training.
        training_return, training_cost: of the last 500 training episodes.
        evaluation_return, evaluation_cost: of the deterministic episodes, decisions held as in training.
        evaluation_p10: tenth percentile of their return.
        stepwise_return, stepwise_cost, stepwise_p10: of as many episodes in which the policy decides every
            control step, as it does once exported.
        violating_steps: of those, a mean.
        multiplier: λ of the last epoch, for a network its mean over the epoch's states.
        multiplier_peak: the largest that this was in any epoch.
    """

    sweep: str
    algorithm: str
    settings: str
    cost_limit: float
    seed: int
    steps: int
    training_return: float
    training_cost: float
    evaluation_return: float
    evaluation_cost: float
    evaluation_p10: float
    stepwise_return: float
    stepwise_cost: float
    stepwise_p10: float
    violating_steps: float
    multiplier: float
    multiplier_peak: float

    @property
    def run(self) -> str:
        """Name of the run's folder."""
        return f"{self.algorithm}-d{self.cost_limit}-s{self.seed}"

    @property
    def cost(self) -> float:
        """The larger of both costs, which has to meet the limit."""
        return max(self.training_cost, self.evaluation_cost)


def finished_runs(folder: Path) -> list[Path]:
    """The folders of a sweep's finished runs."""
    from trainer.train import load_config

    found = []
    for run in sorted(path.parent for path in folder.glob(f"*/{CONFIG}")):
        if (run / checkpoint.FILE).exists():
            _, facts = checkpoint.read(run)
            if int(facts["epoch"]) >= load_config(run).epochs:
                found.append(run)
    return found


def evaluate(run: Path, episodes: int) -> Result:
    """What a finished run came to, with deterministic episodes on layouts that training never saw."""
    from trainer.export import TrainedRun, play

    trained = TrainedRun(run)
    config = trained.config
    played = play(trained, episodes, threads=1, hold=config.action_repeat, use=Use.COMPARISON)
    stepwise = play(trained, episodes, threads=1, use=Use.COMPARISON)
    columns = read_progress(run)
    last = closing(columns, TAIL)
    if last is None:
        raise ValueError(f"{run}: no training episode has ended")
    return Result(
        sweep=run.parent.name,
        algorithm=config.algorithm,
        settings=_settings(config),
        cost_limit=config.cost_limit,
        seed=config.seed,
        steps=trained.steps,
        training_return=last.mean_return,
        training_cost=last.cost,
        evaluation_return=float(played.returns.mean()),
        evaluation_cost=float(played.costs.mean()),
        evaluation_p10=float(np.percentile(played.returns, 10)),
        stepwise_return=float(stepwise.returns.mean()),
        stepwise_cost=float(stepwise.costs.mean()),
        stepwise_p10=float(np.percentile(stepwise.returns, 10)),
        violating_steps=float(np.nansum(stepwise.cost > 0, 0).mean()),
        multiplier=float(columns["multiplier"][-1]),
        multiplier_peak=float(np.nanmax(columns["multiplier"])),
    )


def _settings(config: Config) -> str:
    fields = [field.name for field in dataclasses.fields(Config) if field.name not in OPERATION]
    changed = {
        name: getattr(config, name) for name in fields if getattr(config, name) != getattr(Config(), name)
    }
    return " ".join(f"{name}={value}" for name, value in changed.items())


def read_record(folder: Path) -> list[Result]:
    """The results on record, in their order."""
    path = folder / RUNS
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [_result(row) for row in csv.DictReader(file)]


def _result(row: dict[str, str]) -> Result:
    kinds = {"str": str, "float": float, "int": int}
    values: dict[str, Any] = {
        field.name: kinds[str(field.type)](row[field.name]) for field in dataclasses.fields(Result)
    }
    return Result(**values)


def write_record(folder: Path, results: Iterable[Result]) -> None:
    """Replaces runs.csv, sorted by sweep, algorithm, limit and seed."""
    text = io.StringIO()
    names = [field.name for field in dataclasses.fields(Result)]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for result in sorted(results, key=lambda r: (r.sweep, r.algorithm, r.cost_limit, r.seed)):
        values = dataclasses.asdict(result)
        writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in values.items()})
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint.replace(folder / RUNS, text.getvalue().encode())


def keep_curve(run: Path, folder: Path) -> None:
    """Keeps a thinned progress.csv of a run at folder/SWEEP/RUN, as lagnet-plot reads it."""
    columns = read_progress(run)
    keep = folder / run.parent.name / run.name
    keep.mkdir(parents=True, exist_ok=True)
    rows = np.stack([columns[name][EVERY - 1 :: EVERY] for name in CURVE], axis=1)
    cells = [["" if np.isnan(value) else f"{value:.5g}" for value in row] for row in rows]
    for row, steps in zip(cells, rows[:, 0], strict=True):
        row[0] = f"{steps:.0f}"
    lines = [",".join(row) for row in ([*CURVE], *cells)]
    checkpoint.replace(keep / PROGRESS, ("\n".join(lines) + "\n").encode())


def tables(results: Sequence[Result]) -> list[Table]:
    """What is on record: means over the seeds, and the cost of the worst seed.

    Returns:
        One table a sweep, a section a limit. Sweeps of one algorithm at one limit, such as ablations, share
        a table instead, a row a sweep, if another sweep has the same to compare them with.
    """
    sweeps: dict[str, list[Result]] = defaultdict(list)
    cases: dict[tuple[str, float], list[Result]] = defaultdict(list)
    for result in sorted(results, key=lambda each: each.sweep):
        sweeps[result.sweep].append(result)
        cases[result.algorithm, result.cost_limit].append(result)
    found, compared = [], set()
    for sweep, members in sweeps.items():
        case, *more = {(result.algorithm, result.cost_limit) for result in members}
        if more or {result.sweep for result in cases[case]} == {sweep}:
            found.append(_comparison(sweep, members))
        else:
            compared.add(case)
    return found + [_variants(*case, cases[case]) for case in sorted(compared)]


def _comparison(sweep: str, results: Sequence[Result]) -> Table:
    table = _table(sweep, "d", "algorithm")
    limits = {result.cost_limit for result in results if result.algorithm not in UNLIMITED}
    for limit in sorted(limits or {result.cost_limit for result in results}):
        groups: dict[str, list[Result]] = defaultdict(list)
        for result in results:
            # An algorithm that knows no limit is the same beside every limit.
            if result.cost_limit == limit or result.algorithm in UNLIMITED:
                groups[result.algorithm].append(result)
        _add_rows(table, groups, limit, str(limit))
        table.add_section()
    return table


def _variants(algorithm: str, limit: float, results: Sequence[Result]) -> Table:
    table = _table(f"{algorithm} at d = {limit}", "sweep")
    groups: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        groups[result.sweep].append(result)
    _add_rows(table, groups, limit)
    return table


def _add_rows(table: Table, groups: dict[str, list[Result]], limit: float, *first: str) -> None:
    """A row for each group, by rank; its cells before the group's name are `first`."""
    for name in sorted(groups, key=lambda name: _rank(groups[name], limit)):
        table.add_row(*first, name, *_row(groups[name], limit))


def _table(title: str, *names: str) -> Table:
    table = Table(title=title, title_justify="left")
    for name in names:
        table.add_column(name)
    training, deterministic = ("return", "cost"), ("return, det.", "p10", "cost, det.")
    for name in ("seeds", *training, *deterministic, "worst cost", "met", "every step", "λ", "peak λ"):
        table.add_column(name, justify="right")
    table.add_column("settings")
    return table


def _rank(found: Sequence[Result], limit: float) -> tuple[bool, float]:
    """Sorts those first whose seeds all meet the limit, and then by their return."""
    return any(result.cost > limit for result in found), -_mean(found, "evaluation_return")


def _row(found: Sequence[Result], limit: float) -> list[str]:
    met = sum(result.cost <= limit for result in found)
    return [
        str(len(found)),
        f"{_mean(found, 'training_return'):.1f}",
        f"{_mean(found, 'training_cost'):.2f}",
        f"{_mean(found, 'evaluation_return'):.1f}",
        f"{_mean(found, 'evaluation_p10'):.1f}",
        f"{_mean(found, 'evaluation_cost'):.2f}",
        f"{max(result.cost for result in found):.2f}",
        f"{met} of {len(found)}" if met < len(found) else "yes",
        f"{_mean(found, 'stepwise_return'):.1f} / {_mean(found, 'stepwise_cost'):.2f}",
        f"{_mean(found, 'multiplier'):.2g}",
        f"{max(result.multiplier_peak for result in found):.3g}",
        ", ".join(sorted({result.settings for result in found} - {""})),
    ]


def _mean(found: Sequence[Result], name: str) -> float:
    return fmean(getattr(result, name) for result in found)


def main() -> None:
    """Evaluate what is new, and print the tables."""
    settings = tyro.cli(Comparison, description=Comparison.__doc__)
    console = Console()
    wide = Console(width=max(console.width, 200))
    results = {(result.sweep, result.run): result for result in read_record(settings.record)}
    runs = [(folder.name, run) for folder in settings.folders for run in finished_runs(folder)]
    new = [run for sweep, run in runs if (sweep, run.name) not in results]
    with ProcessPoolExecutor(settings.processes) as pool:
        found = pool.map(evaluate, new, [settings.episodes] * len(new))
        evaluated = track(found, "evaluating", len(new), console=console, disable=not new)
        for run, result in zip(new, evaluated, strict=True):
            results[result.sweep, run.name] = result
            keep_curve(run, settings.record)
            write_record(settings.record, results.values())
    for table in tables(list(results.values())):
        if settings.markdown:
            table.box = box.MARKDOWN
        wide.print(table)


if __name__ == "__main__":
    main()
