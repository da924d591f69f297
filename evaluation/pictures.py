"""Pictures and animations of recorded episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image, ImageDraw, ImageFont

from evaluation.closed_loop import Trajectory
from evaluation.deciders import FloatArray
from filter import Mode
from pointgoal.observation import HAZARD_RADIUS

STEP_SECONDS = 0.02
"""Duration of one step [s]."""
GOAL_RADIUS = 0.3
"""The goal is met within this distance [m]."""

_INK, _GREY, _PAPER, _PANEL = "#1b263b", "#8d99ae", "#ffffff", "#f7f8fa"
_HAZARD, _HAZARD_EDGE = "#f6bdc0", "#d62839"
_GOAL, _ACTED, _VIOLATION = "#2a9d8f", "#f48c06", "#d00000"
_GATE_COLOURS = {"off": "#8d99ae", "risk": "#7b2cbf", "always": "#0077b6"}
_GATE_NAMES = {"off": "no filter", "risk": "filter where λ says so", "always": "filter always"}
_RISK_COLOURS = "viridis_r"


@dataclass(frozen=True)
class Drive:
    """One episode of one robot.

    Attributes:
        pose: [T, 3] x, y [m], heading [rad].
        goal: [T, 2] [m].
        risk: [T] λ_ξ(s).
        acted: [T] whether the action sent was not the nominal one.
        barrier: [T] h [m].
        cost: [T].
        reward: [T].
        hazards: [n, 2] [m].
    """

    pose: FloatArray
    goal: FloatArray
    risk: FloatArray
    acted: np.ndarray
    barrier: FloatArray
    cost: FloatArray
    reward: FloatArray
    hazards: FloatArray

    @property
    def caption(self) -> str:
        """Return, cost and violating steps in words."""
        return (
            f"return {self.reward.sum():.1f}   cost {self.cost.sum():.2f}   "
            f"{(self.cost > 0).sum()} violating steps"
        )


def drive(trajectory: Trajectory, episode: int) -> Drive:
    """One episode out of a recording, up to its end."""
    running = np.isfinite(trajectory.cost[:, episode])
    return Drive(
        pose=trajectory.pose[running, episode],
        goal=trajectory.goal[running, episode],
        risk=trajectory.risk[running, episode],
        acted=trajectory.mode[running, episode] != Mode.NOMINAL,
        barrier=trajectory.barrier[running, episode],
        cost=trajectory.cost[running, episode],
        reward=trajectory.reward[running, episode],
        hazards=trajectory.hazards[episode],
    )


def draw_drives(path: Path, drives: Mapping[str, Drive], threshold: float, title: str) -> None:
    """Draws the same episode under several gates: the paths above, what happened over time below.

    Args:
        path: the PNG to write.
        drives: gate → what the robot did.
        threshold: of the gate `risk`.
        title: a line above.
    """
    with mpl.rc_context({"font.size": 9.5, "axes.edgecolor": _GREY, "text.color": _INK, "axes.labelcolor": _INK}):
        figure = Figure(figsize=(4.1 * len(drives), 8.6), facecolor=_PAPER)
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(
            4, len(drives), height_ratios=[10, 2.4, 2.4, 2.4], left=0.055, right=0.985, top=0.89, bottom=0.06, hspace=0.42,
            wspace=0.06,
        )
        figure.suptitle(title, x=0.055, ha="left", fontsize=14, fontweight="bold")
        highest = max(np.nanpercentile(drive.risk, 99) for drive in drives.values())
        colours = Normalize(0.0, max(highest, 1e-9))
        reach = max(np.abs(np.vstack([drive.pose[:, :2], drive.goal, drive.hazards])).max() for drive in drives.values())
        for column, (gate, one) in enumerate(drives.items()):
            axes = figure.add_subplot(grid[0, column])
            _draw_path(axes, one, colours, reach + 0.35)
            axes.set_title(_GATE_NAMES.get(gate, gate), loc="left", fontweight="bold", color=_GATE_COLOURS.get(gate, _INK))
            axes.text(0.0, -0.03, one.caption, transform=axes.transAxes, va="top", fontsize=9.5)
        _legend(figure, colours)
        _draw_over_time(figure, grid, drives, threshold)
        figure.savefig(path, dpi=130)


def _draw_path(axes: Axes, one: Drive, colours: Normalize, reach: float) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_facecolor(_PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    for goal in _goals_met(one):
        axes.add_patch(Circle(tuple(goal), GOAL_RADIUS, facecolor=_GOAL, edgecolor=_GOAL, alpha=0.13, lw=0.8))
    for hazard in one.hazards:
        axes.add_patch(Circle(tuple(hazard), HAZARD_RADIUS, facecolor=_HAZARD, edgecolor=_HAZARD_EDGE, lw=1.1))
    points = one.pose[:, None, :2]
    segments = np.concatenate([points[:-1], points[1:]], axis=1)
    lines = LineCollection(list(segments), cmap=_RISK_COLOURS, norm=colours, linewidths=1.5, capstyle="round")
    lines.set_array(one.risk[:-1])
    axes.add_collection(lines)
    for mask, colour, size in ((one.acted, _ACTED, 5.0), (one.cost > 0.0, _VIOLATION, 9.0)):
        axes.scatter(*one.pose[mask, :2].T, s=size, color=colour, linewidths=0, zorder=3)
    axes.scatter(*one.pose[0, :2], s=46, facecolor=_PAPER, edgecolor=_INK, linewidths=1.6, zorder=4)


def _goals_met(one: Drive) -> FloatArray:
    """The goals of an episode [k, 2], in order."""
    fresh = np.ones(len(one.goal), dtype=bool)
    fresh[1:] = (one.goal[1:] != one.goal[:-1]).any(axis=1)
    return one.goal[fresh]


def _legend(figure: Figure, colours: Normalize) -> None:
    strip = figure.add_axes((0.055, 0.917, 0.13, 0.012))
    gradient = np.linspace(colours.vmin or 0.0, colours.vmax or 1.0, 256)[None]
    strip.imshow(gradient, aspect="auto", cmap=_RISK_COLOURS, extent=(0.0, float(colours.vmax or 1.0), 0.0, 1.0))
    strip.set_yticks([])
    strip.tick_params(labelsize=8, length=2)
    strip.xaxis.tick_top()
    figure.text(0.192, 0.917, "λ along the path", fontsize=9)
    entries = ((_ACTED, "the filter acted"), (_VIOLATION, "inside a hazard (violation)"), (_GOAL, "goals"), (_HAZARD_EDGE, "hazards"))
    for place, (colour, label) in zip((0.33, 0.48, 0.69, 0.77), entries, strict=True):
        figure.text(place, 0.917, "●", color=colour, fontsize=10)
        figure.text(place + 0.014, 0.917, label, fontsize=9)


def _draw_over_time(figure: Figure, grid: mpl.gridspec.GridSpec, drives: Mapping[str, Drive], threshold: float) -> None:
    risk, barrier, cost = (figure.add_subplot(grid[row, :]) for row in (1, 2, 3))
    for gate, one in drives.items():
        seconds = np.arange(len(one.cost)) * STEP_SECONDS
        style = {"color": _GATE_COLOURS.get(gate, _INK), "lw": 1.2, "label": _GATE_NAMES.get(gate, gate)}
        risk.plot(seconds, one.risk, **style)
        barrier.plot(seconds, one.barrier, **style)
        cost.plot(seconds, np.cumsum(one.cost), **(style | {"lw": 2.0}))
    risk.axhline(threshold, color=_INK, lw=0.9, ls=(0, (4, 3)))
    risk.text(0.0, threshold, " threshold", va="bottom", fontsize=8)
    barrier.axhline(0.0, color=_VIOLATION, lw=0.9)
    for axes, label in ((risk, "λ"), (barrier, "barrier h [m]"), (cost, "cost so far")):
        axes.set_ylabel(label)
        axes.set_facecolor(_PANEL)
        axes.margins(x=0.0)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        if axes is not cost:
            axes.tick_params(labelbottom=False)
    cost.set_xlabel("time [s]")
    cost.legend(loc="upper left", ncols=len(drives), frameon=False, fontsize=9)
