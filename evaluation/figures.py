"""The paper's figures 5 and 6: reward, cost and λ over one unfiltered episode, and two moments of it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from inference import Networks
from models import Bundle
from pointgoal import seeds
from pointgoal.loop import drive
from pointgoal.scene import STEP_SECONDS
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv

FloatArray = NDArray[np.float64]

_TRIES = 50
_ROWS = (("reward", "#0077b6"), ("cost", "#d62839"), ("λ", "#2a9d8f"))


@dataclass(frozen=True)
class Episode:
    """One unfiltered episode of T steps.

    Attributes:
        layout: its seed.
        reward: [T].
        cost: [T].
        risk: [T] λ_ξ(s) before each step.
    """

    layout: int
    reward: FloatArray
    cost: FloatArray
    risk: FloatArray

    @property
    def peak(self) -> int:
        """The step at which λ is largest: the black star."""
        return int(self.risk.argmax())

    @property
    def safe(self) -> int:
        """The step at which λ is smallest: the white star."""
        return int(self.risk.argmin())


def play(bundle: Bundle, layout: int, moments: Sequence[int] = ()) -> tuple[Episode, list[NDArray[Any]]]:
    """Drives one episode without filter.

    Returns:
        The episode, and pictures (height, width, 3) of the states before the steps `moments`, in order.
    """
    networks = Networks(bundle)
    env = PointGoalVectorEnv(bundle.manifest.level, 1, render_mode="rgb_array")
    risks: list[float] = []
    pictures: dict[int, NDArray[Any]] = {}

    def act(observation: FloatArray, env: PointGoalVectorEnv) -> FloatArray:
        rendered = env.render() if len(risks) in moments else None
        if rendered is not None:
            pictures[len(risks)] = rendered[0]
        action, risk = networks.run(observation)
        risks.append(float(risk[0]))
        return action

    steps = [(float(step.reward[0]), float(step.cost[0])) for step in drive(env, act, [layout])]
    env.close()
    reward, cost = np.array(steps).T
    return Episode(layout, reward, cost, np.array(risks)), [pictures[moment] for moment in moments]


def choose(bundle: Bundle, seed: int) -> Episode:
    """The first episode of the evaluation's layouts that has a violation, or else the last that was tried."""
    for layout in seeds.rows(Use.EVALUATION, seed, _TRIES):
        episode, _ = play(bundle, layout)
        if (episode.cost > 0.0).any():
            break
    return episode


def write_figures(bundle: Bundle, seed: int, folder: Path) -> Episode:
    """Writes figure5.png, figure6.png and figure5.csv into the folder, and returns the episode."""
    episode = choose(bundle, seed)
    again, frames = play(bundle, episode.layout, [episode.peak, episode.safe])
    if again.risk.tobytes() != episode.risk.tobytes():
        raise RuntimeError("the same episode went another way")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "figure5.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["step", "reward", "cost", "multiplier"])
        writer.writerows(zip(range(len(again.cost)), again.reward, again.cost, again.risk, strict=True))
    _over_time(episode, bundle, folder / "figure5.png")
    _moments(episode, frames, folder / "figure6.png")
    return episode


def _over_time(episode: Episode, bundle: Bundle, path: Path) -> None:
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    manifest = bundle.manifest
    figure.suptitle(f"One episode of {manifest.name} ({manifest.algorithm}) without filter", fontsize=11)
    time = np.arange(len(episode.cost)) * STEP_SECONDS
    rows: Sequence[Axes] = figure.subplots(3, 1, sharex=True, height_ratios=(1.0, 1.0, 1.4))
    for axes, (label, colour), values in zip(
        rows, _ROWS, (episode.reward, episode.cost, episode.risk), strict=True
    ):
        axes.plot(time, values, color=colour, lw=1.2)
        axes.set_ylabel(label)
        axes.grid(color="#e9ecf1")
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    for step, face, words in ((episode.peak, "black", "(a)"), (episode.safe, "white", "(b)")):
        place = time[step], episode.risk[step]
        rows[2].plot(*place, "*", ms=15, mfc=face, mec="black", zorder=5, clip_on=False)
        rows[2].annotate(words, place, (9, 6), textcoords="offset points", fontsize=9)
    rows[2].set_xlabel("time [s]")
    rows[2].margins(x=0.01, y=0.15)
    figure.savefig(path, dpi=150)


def _moments(episode: Episode, frames: Sequence[NDArray[Any]], path: Path) -> None:
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    moments = (("(a) λ at its largest", episode.peak), ("(b) λ at its smallest", episode.safe))
    for axes, frame, (words, step) in zip(figure.subplots(1, 2), frames, moments, strict=True):
        axes.imshow(frame)
        axes.set_axis_off()
        value, cost = f"{episode.risk[step]:.3g}", f"{episode.cost[step]:.3f}"
        axes.set_title(f"{words}: {value} at {step * STEP_SECONDS:.1f} s, cost {cost}", fontsize=10)
    figure.savefig(path, dpi=150)
