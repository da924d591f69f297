"""How well λ warns of violations: on fresh unfiltered episodes, beside scores that need no learning."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from command import progress_bar
from evaluation.errors import CalibrateError
from filter import BarrierFilter
from inference import Networks
from models import Bundle
from pointgoal import seeds
from pointgoal.loop import SIDE_BY_SIDE, drive, groups
from pointgoal.scene import STEP_SECONDS
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS
from pointgoal.vector import PointGoalVectorEnv
from trainer.features import COASTING

if TYPE_CHECKING:
    from evaluation.calibrate import CalibrateConfig

FloatArray = NDArray[np.float64]
Critic = Callable[[FloatArray], FloatArray]
BoolArray = NDArray[np.bool_]

HORIZONS = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Within which a violation begins [s]."""
CAUGHT = 0.95
"""Share of violations that every score's threshold is set to catch, to compare false alarms and lead."""
AHEAD = 0.25
"""How long before a violation it has to be caught [s]: about what braking from top speed takes."""
RESAMPLES = 200
SCORES = {
    "λ": "λ, from the observation",
    "coasting": "clearance of coasting, hazards given",
    "distance": "distance to the nearest hazard",
    "barrier": "the filter's barrier, from the observation",
}
CRITIC = "cost critic"
"""Name and label of the score that a training run adds: what its cost critic expects to follow."""
_COLOURS = {
    "λ": "#7b2cbf",
    "coasting": "#f48c06",
    "distance": "#8d99ae",
    "barrier": "#2a9d8f",
    CRITIC: "#d62828",
}


@dataclass(frozen=True)
class Drives:
    """E unfiltered episodes of T steps.

    Attributes:
        cost: of each step [T, E].
        scores: name → the larger, the nearer a violation [T, E].
    """

    cost: FloatArray
    scores: dict[str, FloatArray]


@dataclass(frozen=True)
class Quality:
    """How well one score warns.

    Attributes:
        auroc: for each horizon: value, and its 95 % interval over episodes.
        precision: average precision, likewise.
        threshold: above which `CAUGHT` of the violations are seen `AHEAD` s before they begin.
        alarms_per_hour: alarms at that threshold that no violation follows within 2 s.
        lead: seconds before each violation since which the score was above the threshold, its 10th, 50th and
            90th percentile.
    """

    auroc: dict[str, tuple[float, float, float]]
    precision: dict[str, tuple[float, float, float]]
    threshold: float
    alarms_per_hour: float
    lead: tuple[float, float, float]


def play(bundle: Bundle, episodes: int, seed: int, console: Console, critic: Critic | None = None) -> Drives:
    """Drives unfiltered episodes on layouts that nothing was chosen on; scored by a cost critic as well."""
    networks, robot_filter = Networks(bundle), BarrierFilter()
    cost = np.zeros((EPISODE_STEPS, episodes))
    scores = {name: np.zeros_like(cost) for name in (*SCORES, *(() if critic is None else (CRITIC,)))}
    layouts = seeds.rows(Use.WARNING_REPORT, seed, episodes)
    with progress_bar(console) as bar:
        job = bar.add_task("unfiltered episodes", total=episodes * EPISODE_STEPS)
        for part in groups(episodes, SIDE_BY_SIDE):
            env = PointGoalVectorEnv(bundle.manifest.level, part.stop - part.start)
            now: dict[str, FloatArray] = {}

            def act(
                observation: FloatArray, env: PointGoalVectorEnv, now: dict[str, FloatArray] = now
            ) -> FloatArray:
                action, now["λ"] = networks.run(observation)
                hazards = env.hazards_in_body_frame()
                now["distance"] = -np.hypot(hazards[..., 0], hazards[..., 1]).min(axis=1)
                now["coasting"] = -coasting_clearance(observation[:, 3:5], hazards)
                now["barrier"] = -robot_filter.look(observation).barrier
                if critic is not None:
                    now[CRITIC] = critic(observation)
                return action

            for t, step in enumerate(drive(env, act, layouts[part])):
                cost[t, part] = step.cost
                for name, score in now.items():
                    scores[name][t, part] = score
                bar.advance(job, len(step.cost))
            env.close()
    return Drives(cost, scores)


def cost_critic(folder: Path, bundle: Bundle) -> Critic:
    """V_c of a training run's last checkpoint: observations (N, O) → discounted cost that it expects (N,).

    Raises:
        CalibrateError: if the folder holds no checkpoint that can be read, or one of another task than the
            bundle's.
    """
    import torch

    from trainer.errors import TrainerError
    from trainer.export import TrainedRun
    from trainer.learner import COST
    from trainer.train import why_not_exported

    try:
        run = TrainedRun(folder)
    except TrainerError as error:
        raise CalibrateError(f"--run: {error}") from error
    task = bundle.manifest.task
    if run.config.task != task:
        raise CalibrateError(f"--run {folder}: it is of task {run.config.task}, the bundle is of {task}")
    if why := why_not_exported(run.config):
        raise CalibrateError(f"--run {folder}: {why}")
    torch.set_num_threads(1)

    def value(observation: FloatArray) -> FloatArray:
        inputs = run.learner.inputs(observation.astype(np.float32))
        with torch.no_grad():
            return run.learner.values(inputs)[COST].double().numpy()

    return value


def coasting_clearance(velocity: FloatArray, hazards: FloatArray) -> FloatArray:
    """Distance (N,) of the nearest hazard's centre (N, n, 2) from the way on which the robot coasts [m]."""
    way = COASTING * velocity[:, None]
    share = (hazards * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-12)
    apart = hazards - np.clip(share, 0.0, 1.0)[..., None] * way
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]).min(axis=1))


def judge(drives: Drives, name: str, seed: int) -> Quality:
    """Measures one score; the intervals are bootstrapped over episodes."""
    cost, score = drives.cost, drives.scores[name]
    rng = seeds.generator(Use.WARNING_REPORT, seed)
    draws = [rng.integers(0, cost.shape[1], cost.shape[1]) for _ in range(RESAMPLES)]
    auroc, precision = {}, {}
    for horizon in HORIZONS:
        soon, counted = labels(cost, round(horizon / STEP_SECONDS))
        told = _Ranked.of(score, soon, counted)
        both = np.array([told.quality(np.bincount(draw, minlength=cost.shape[1])) for draw in draws])
        whole = told.quality(np.ones(cost.shape[1]))
        low, high = np.nanpercentile(both, [2.5, 97.5], axis=0)
        auroc[f"{horizon:g}"] = (whole[0], float(low[0]), float(high[0]))
        precision[f"{horizon:g}"] = (whole[1], float(low[1]), float(high[1]))
    threshold = threshold_to_catch(cost, score)
    above = score >= threshold
    return Quality(auroc, precision, threshold, false_alarms(cost, above), lead(cost, above))


def labels(cost: FloatArray, steps: int) -> tuple[BoolArray, BoolArray]:
    """Whether a violation begins within so many steps [T, E], and which states count [T, E].

    Those inside a violation do not, nor do those whose episode ends before it is known.
    """
    violating = cost > 0.0
    until = np.full(cost.shape, np.inf)
    nearest = np.full(cost.shape[1], np.inf)
    for t in reversed(range(len(cost))):
        nearest = np.where(violating[t], 0.0, nearest + 1.0)
        until[t] = nearest
    soon = until < steps
    outside = np.vstack([np.ones((1, cost.shape[1]), bool), ~violating[:-1]])
    known = soon | (np.arange(len(cost))[:, None] <= len(cost) - steps)
    return soon, outside & known


@dataclass(frozen=True)
class _Ranked:
    """The states that count, from the highest score on: label, episode, and where equal scores end."""

    soon: BoolArray
    episode: NDArray[np.intp]
    last: NDArray[np.intp]

    @staticmethod
    def of(score: FloatArray, soon: BoolArray, counted: BoolArray) -> _Ranked:
        episode = np.broadcast_to(np.arange(score.shape[1]), score.shape)[counted]
        order = np.argsort(-score[counted], kind="stable")
        falling = score[counted][order]
        last = np.append(np.flatnonzero(np.diff(falling)), len(falling) - 1)
        return _Ranked(soon[counted][order], episode[order], last)

    def quality(self, weight: NDArray[Any]) -> tuple[float, float]:
        """Area under the ROC curve, and average precision, with so much weight for each episode (E,)."""
        weights = weight[self.episode]
        hits = np.cumsum(weights * self.soon)[self.last]
        alarms = np.cumsum(weights * ~self.soon)[self.last]
        if hits[-1] == 0.0 or alarms[-1] == 0.0:
            return float("nan"), float("nan")
        recall, fall_out = np.append(0.0, hits / hits[-1]), np.append(0.0, alarms / alarms[-1])
        area = float(np.trapezoid(recall, fall_out))
        precision = hits / np.maximum(hits + alarms, 1e-12)
        return area, float((np.diff(recall) * precision).sum())


def onsets(cost: FloatArray) -> list[tuple[int, int]]:
    """Where violations begin: step and episode."""
    violating = cost > 0.0
    begins = violating & ~np.vstack([np.zeros((1, cost.shape[1]), bool), violating[:-1]])
    return [(int(t), int(e)) for t, e in zip(*np.nonzero(begins), strict=True)]


def threshold_to_catch(cost: FloatArray, score: FloatArray) -> float:
    """The highest threshold that `CAUGHT` of the violations reach at some moment `AHEAD` s before or earlier.

    Earlier means since the last violation ended, at most 2 s.
    """
    reached = []
    for t, e in onsets(cost):
        end = t - round(AHEAD / STEP_SECONDS) + 1
        start = max(0, t - round(HORIZONS[-1] / STEP_SECONDS))
        if end > start:
            reached.append(score[start:end, e].max())
    return float(np.quantile(reached, 1.0 - CAUGHT)) if reached else float("inf")


def false_alarms(cost: FloatArray, above: BoolArray) -> float:
    """Alarms an hour, times at which a score rises above its threshold, that no violation follows in 2 s."""
    soon, counted = labels(cost, round(HORIZONS[-1] / STEP_SECONDS))
    rises = above & ~np.vstack([np.zeros((1, cost.shape[1]), bool), above[:-1]])
    hours = counted.sum() * STEP_SECONDS / 3600.0
    return float((rises & counted & ~soon).sum() / hours)


def lead(cost: FloatArray, above: BoolArray) -> tuple[float, float, float]:
    """For how long a score was above its threshold when violations began [s]: 10th, 50th, 90th percentile."""
    leads = []
    for t, e in onsets(cost):
        before = above[:t, e][::-1]
        leads.append(STEP_SECONDS * float(before.size if before.all() else before.argmin()))
    low, middle, high = np.percentile(leads, [10, 50, 90]) if leads else (np.nan,) * 3
    return float(low), float(middle), float(high)


def report(config: CalibrateConfig, console: Console) -> Table:
    """Measures, writes figures and picture into the folder, and returns the table."""
    assert config.report is not None
    bundle = Bundle.load(config.bundle)
    critic = None if config.run is None else cost_critic(config.run, bundle)
    drives = play(bundle, config.episodes, config.seed, console, critic)
    found = {name: judge(drives, name, config.seed) for name in drives.scores}
    config.report.mkdir(parents=True, exist_ok=True)
    content = {
        "bundle": bundle.id,
        "episodes": config.episodes,
        "seed": config.seed,
        "violations": len(onsets(drives.cost)),
        "scores": {name: vars(quality) for name, quality in found.items()},
    }
    figures = json.dumps(content, indent=2, ensure_ascii=False) + "\n"
    (config.report / "warning.json").write_text(figures, encoding="utf-8")
    draw(found, bundle.id, config.episodes, config.report / "warning.png")
    return table(
        found, f"{bundle.id}: {config.episodes} unfiltered episodes, {content['violations']} violations"
    )


def table(found: dict[str, Quality], title: str) -> Table:
    """The scores side by side."""
    made = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    made.add_column("AUROC within", no_wrap=True)
    for horizon in HORIZONS:
        made.add_column(f"{horizon:g} s", justify="right", no_wrap=True)
    made.add_column("false alarms\nan hour", justify="right")
    made.add_column("lead [s]\n10 / 50 / 90 %", justify="right")
    for name, quality in found.items():
        cells = [f"{value:.3f}\n±{(high - low) / 2:.3f}" for value, low, high in quality.auroc.values()]
        leads = " / ".join(f"{value:.2f}" for value in quality.lead)
        made.add_row(name, *cells, f"{quality.alarms_per_hour:.0f}", leads)
    return made


def draw(found: dict[str, Quality], who: str, episodes: int, path: Path) -> None:
    """Draws AUROC and average precision over the horizon, with their intervals."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"How well a violation is foreseen: {who}, {episodes} unfiltered episodes", fontsize=11)
    left, right = figure.subplots(1, 2)
    for axes, kind, label in (
        (left, "auroc", "area under the ROC curve"),
        (right, "precision", "average precision"),
    ):
        for name, quality in found.items():
            value, low, high = np.array(list(getattr(quality, kind).values())).T
            axes.fill_between(HORIZONS, low, high, color=_COLOURS[name], alpha=0.18, lw=0)
            axes.plot(HORIZONS, value, "o-", ms=4, lw=2, color=_COLOURS[name], label=SCORES.get(name, name))
        axes.set_xscale("log")
        axes.set_xticks(HORIZONS, [f"{horizon:g}" for horizon in HORIZONS])
        axes.minorticks_off()
        axes.set_xlabel("a violation begins within [s]")
        axes.set_title(label, fontsize=10, loc="left")
        axes.grid(color="#e9ecf1")
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    left.legend(frameon=False, fontsize=9, loc="lower left")
    figure.savefig(path, dpi=150)
