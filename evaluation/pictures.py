"""Pictures and animations of recorded episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image, ImageColor, ImageDraw, ImageFont

from evaluation.closed_loop import Trajectory
from evaluation.deciders import FloatArray
from filter import Mode
from pointgoal.observation import HAZARD_RADIUS
from pointgoal.scene import PHYSICS_STEPS, TIMESTEP
from pointgoal.simulation import GOAL_RADIUS

STEP_SECONDS = TIMESTEP * PHYSICS_STEPS
"""Duration of one step [s]."""

_INK, _GREY, _PAPER, _PANEL = "#1b263b", "#8d99ae", "#ffffff", "#f7f8fa"
_HAZARD, _HAZARD_EDGE = "#f6bdc0", "#d62839"
_GOAL, _ACTED, _VIOLATION = "#2a9d8f", "#f48c06", "#d00000"
_GATE_COLOURS = {"off": "#8d99ae", "risk": "#7b2cbf", "always": "#0077b6"}
_GATE_NAMES = {"off": "no filter", "risk": "filter where λ says so", "always": "filter always"}
_RISK_COLOURS = "viridis_r"
_TRAIL, _GOAL_PALE = "#9fb3c8", "#cfe8e4"
_SIDE, _GUTTER, _STRIP, _SHARP = 360, 14, 44, 2
"""Of the animation [pixels]: a panel's side, the gap, the words above; and how much finer it is drawn."""
_FRAME_MILLISECONDS, _LAST_MILLISECONDS = 50, 2000
_ROBOT_RADIUS = 0.1
_PANEL_INCHES, _GAP_INCHES, _MARGINS = 3.95, 0.2, 1.0


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
    with mpl.rc_context(
        {"font.size": 9.5, "axes.edgecolor": _GREY, "text.color": _INK, "axes.labelcolor": _INK}
    ):
        width = _MARGINS + len(drives) * _PANEL_INCHES + (len(drives) - 1) * _GAP_INCHES
        height = _PANEL_INCHES + 5.35
        figure = Figure(figsize=(width, height), facecolor=_PAPER)
        FigureCanvasAgg(figure)
        lefts = [(0.75 + k * (_PANEL_INCHES + _GAP_INCHES)) / width for k in range(len(drives))]
        figure.text(lefts[0], 1.0 - 0.38 / height, title, fontsize=15, fontweight="bold")
        colours = Normalize(
            0.0, max(1e-9, *(float(np.nanpercentile(one.risk, 99)) for one in drives.values()))
        )
        window = _window(drives)
        for left, (gate, one) in zip(lefts, drives.items(), strict=True):
            axes = figure.add_axes((left, 3.95 / height, _PANEL_INCHES / width, _PANEL_INCHES / height))
            _draw_path(axes, one, colours, window)
            name = _GATE_NAMES.get(gate, gate)
            axes.set_title(name, loc="left", fontweight="bold", color=_GATE_COLOURS.get(gate, _INK))
            axes.text(0.0, -0.025, one.caption, transform=axes.transAxes, va="top")
        _legend(figure, colours, lefts[0], 1.0 - 0.78 / height)
        rows = [
            figure.add_axes((lefts[0], bottom / height, 1.0 - lefts[0] - 0.25 / width, 0.85 / height))
            for bottom in (2.55, 1.53, 0.51)
        ]
        _draw_over_time(rows, drives, threshold)
        figure.savefig(path, dpi=130)


def _window(drives: Mapping[str, Drive]) -> tuple[float, float, float]:
    """Centre x, y and half the side of the square that holds every path, goal and hazard [m]."""
    margins = [(one.pose[:, :2], 0.15) for one in drives.values()]
    margins += [(one.goal, GOAL_RADIUS + 0.05) for one in drives.values()]
    margins += [(one.hazards, HAZARD_RADIUS + 0.05) for one in drives.values()]
    low = np.min([points.min(axis=0) - margin for points, margin in margins if len(points)], axis=0)
    high = np.max([points.max(axis=0) + margin for points, margin in margins if len(points)], axis=0)
    centre = (low + high) / 2.0
    return float(centre[0]), float(centre[1]), float((high - low).max() / 2.0)


def _draw_path(axes: Axes, one: Drive, colours: Normalize, window: tuple[float, float, float]) -> None:
    x, y, reach = window
    axes.set_xlim(x - reach, x + reach)
    axes.set_ylim(y - reach, y + reach)
    axes.set_facecolor(_PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    for goal in _goals_met(one):
        axes.add_patch(Circle(tuple(goal), GOAL_RADIUS, facecolor=_GOAL, edgecolor=_GOAL, alpha=0.13, lw=0.8))
    for hazard in one.hazards:
        axes.add_patch(
            Circle(tuple(hazard), HAZARD_RADIUS, facecolor=_HAZARD, edgecolor=_HAZARD_EDGE, lw=1.1)
        )
    points = one.pose[:, None, :2]
    segments = np.concatenate([points[:-1], points[1:]], axis=1)
    lines = LineCollection(list(segments), cmap=_RISK_COLOURS, norm=colours, linewidths=1.5, capstyle="round")
    lines.set_array(one.risk[:-1])
    axes.add_collection(lines)
    for mask, colour, size in ((one.acted, _ACTED, 5.0), (one.cost > 0.0, _VIOLATION, 9.0)):
        axes.scatter(one.pose[mask, 0], one.pose[mask, 1], s=size, color=colour, linewidths=0, zorder=3)
    axes.scatter(
        one.pose[0, 0], one.pose[0, 1], s=46, facecolor=_PAPER, edgecolor=_INK, linewidths=1.6, zorder=4
    )


def _goals_met(one: Drive) -> FloatArray:
    """The goals of an episode [k, 2], in order."""
    fresh = np.ones(len(one.goal), dtype=bool)
    fresh[1:] = (one.goal[1:] != one.goal[:-1]).any(axis=1)
    return one.goal[fresh]


def _legend(figure: Figure, colours: Normalize, left: float, bottom: float) -> None:
    width, height = figure.get_size_inches()
    highest = float(colours.vmax or 1.0)
    strip = figure.add_axes((left, bottom, 1.5 / width, 0.11 / height))
    gradient = np.linspace(0.0, 1.0, 256)[None]
    strip.imshow(gradient, aspect="auto", cmap=_RISK_COLOURS, extent=(0.0, 1.0, 0.0, 1.0))
    strip.set_axis_off()
    figure.text(left + 1.58 / width, bottom, f"λ along the path, 0 to {highest:.2g}", fontsize=9)
    entries = (
        (_ACTED, "the filter acted"),
        (_VIOLATION, "inside a hazard: a violation"),
        (_HAZARD_EDGE, "hazard"),
        (_GOAL, "goal"),
    )
    for inches, (colour, label) in zip((4.0, 5.6, 8.0, 9.0), entries, strict=True):
        figure.text(left + inches / width, bottom, "●", color=colour, fontsize=10)
        figure.text(left + (inches + 0.17) / width, bottom, label, fontsize=9)


def _draw_over_time(rows: list[Axes], drives: Mapping[str, Drive], threshold: float) -> None:
    risk, barrier, cost = rows
    for order, (gate, one) in enumerate(drives.items()):
        seconds = np.arange(len(one.cost)) * STEP_SECONDS
        colour, name = _GATE_COLOURS.get(gate, _INK), _GATE_NAMES.get(gate, gate)
        # Gates that decide alike draw over one another: the later, the thinner.
        wide = 1.1 + 1.1 * (len(drives) - 1 - order)
        risk.plot(seconds, one.risk, color=colour, lw=wide, label=name)
        barrier.plot(seconds, one.barrier, color=colour, lw=wide)
        cost.plot(seconds, np.cumsum(one.cost), color=colour, lw=wide)
    risk.set_ylim(bottom=0.0)
    risk.axhline(threshold, color=_INK, lw=0.9, ls=(0, (4, 3)))
    across = risk.get_yaxis_transform()
    risk.text(0.998, threshold, "threshold", va="bottom", ha="right", fontsize=8, transform=across)
    barrier.axhspan(-9.0, 0.0, color=_HAZARD, alpha=0.6, lw=0)
    barrier.set_ylim(-0.12, 0.8)
    for axes, label in ((risk, "λ"), (barrier, "barrier h [m]"), (cost, "cost so far")):
        axes.set_ylabel(label)
        axes.yaxis.set_label_coords(-0.04, 0.5)
        axes.set_facecolor(_PANEL)
        axes.margins(x=0.0)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.tick_params(labelbottom=axes is cost, labelsize=8.5)
    cost.set_xlabel("time [s]", labelpad=1)
    cost.legend(*risk.get_legend_handles_labels(), loc="upper left", ncols=len(drives), frameon=False)


def animate(path: Path, drives: Mapping[str, Drive], speed: float = 2.5) -> None:
    """Draws the same episode under several gates side by side, as a GIF.

    Args:
        path: the GIF to write.
        drives: gate → what the robot did.
        speed: how many times as fast as it was.
    """
    length = max(len(one.cost) for one in drives.values())
    stride = max(1, round(speed * _FRAME_MILLISECONDS / (1000.0 * STEP_SECONDS)))
    window = _window(drives)
    panels = [_Panel(gate, one, window) for gate, one in drives.items()]
    frames = []
    for step in range(0, length, stride):
        frame = Image.new("RGB", (_SIDE * len(panels) + _GUTTER * (len(panels) - 1), _SIDE + _STRIP), _PAPER)
        for column, panel in enumerate(panels):
            frame.paste(panel.frame(step, stride), (column * (_SIDE + _GUTTER), 0))
        frames.append(frame)
    palette = _palette()
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [_FRAME_MILLISECONDS] * (len(small) - 1) + [_LAST_MILLISECONDS]
    small[0].save(path, save_all=True, append_images=small[1:], duration=durations, loop=0, optimize=False)


class _Panel:
    """One gate's part of the animation; keeps the path drawn so far."""

    def __init__(self, gate: str, one: Drive, window: tuple[float, float, float]) -> None:
        self._drive = one
        self._title = _GATE_NAMES.get(gate, gate)
        self._colour = _GATE_COLOURS.get(gate, _INK)
        self._x, self._y, reach = window
        self._scale = _SIDE * _SHARP / (2.0 * reach)
        self._half = _SIDE * _SHARP / 2.0
        self._floor = Image.new("RGB", (_SIDE * _SHARP, _SIDE * _SHARP), _PANEL)
        self._pen = ImageDraw.Draw(self._floor)
        for hazard in one.hazards:
            self._circle(
                self._pen, hazard, HAZARD_RADIUS, fill=_HAZARD, outline=_HAZARD_EDGE, width=2 * _SHARP
            )
        self._drawn = 0

    def frame(self, step: int, stride: int) -> Image.Image:
        """The panel after a step, with the strip of words below."""
        one, last = self._drive, len(self._drive.cost) - 1
        now = min(step, last)
        for k in range(self._drawn, now):
            ends = [self._at(point) for point in one.pose[k : k + 2, :2]]
            colour = _VIOLATION if one.cost[k] > 0 else _ACTED if one.acted[k] else _TRAIL
            self._pen.line(ends, fill=colour, width=(4 if colour != _TRAIL else 2) * _SHARP)
        self._drawn = now
        picture = self._floor.copy()
        pen = ImageDraw.Draw(picture)
        self._circle(pen, one.goal[now], GOAL_RADIUS, fill=_GOAL_PALE, outline=_GOAL, width=2 * _SHARP)
        recent = slice(max(0, now - stride + 1), now + 1)
        hurt, acted = (one.cost[recent] > 0).any(), one.acted[recent].any()
        body = _VIOLATION if hurt else _ACTED if acted else _INK
        centre, heading = one.pose[now, :2], one.pose[now, 2]
        self._circle(pen, centre, _ROBOT_RADIUS, fill=body)
        nose = centre + 0.16 * np.array([np.cos(heading), np.sin(heading)])
        pen.line([self._at(centre), self._at(nose)], fill=body, width=5 * _SHARP)
        whole = Image.new("RGB", (_SIDE, _SIDE + _STRIP), _PAPER)
        whole.paste(picture.reduce(_SHARP), (0, _STRIP))
        words = ImageDraw.Draw(whole)
        words.text((4, 3), self._title, fill=self._colour, font=_font(15, bold=True))
        gained, hurts = one.reward[: now + 1].sum(), (one.cost[: now + 1] > 0).sum()
        words.text((4, 23), f"return {gained:4.1f}", fill=_INK, font=_font(13))
        alarm = _VIOLATION if hurts else _INK
        words.text((108, 23), f"violating steps {hurts}", fill=alarm, font=_font(13, bold=bool(hurts)))
        return whole

    def _at(self, point: FloatArray) -> tuple[float, float]:
        return (
            self._half + self._scale * float(point[0] - self._x),
            self._half - self._scale * float(point[1] - self._y),
        )

    def _circle(self, pen: ImageDraw.ImageDraw, centre: FloatArray, radius: float, **style: Any) -> None:
        x, y = self._at(centre)
        r = radius * self._scale
        pen.ellipse((x - r, y - r, x + r, y + r), **style)


def _palette() -> Image.Image:
    """Every colour of the animation, blended with its grounds; one frame would lack the rare ones."""
    colours = [
        _INK,
        _HAZARD,
        _HAZARD_EDGE,
        _GOAL,
        _GOAL_PALE,
        _ACTED,
        _VIOLATION,
        _TRAIL,
        *_GATE_COLOURS.values(),
    ]
    blends = [
        ImageColor.getrgb(ground)[i] + share * (ImageColor.getrgb(colour)[i] - ImageColor.getrgb(ground)[i])
        for ground in (_PANEL, _PAPER, _HAZARD)
        for colour in colours
        for share in (0.0, 0.33, 0.67, 1.0)
        for i in range(3)
    ]
    image = Image.new("P", (1, 1))
    image.putpalette([round(value) for value in blends])
    return image


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = font_manager.FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return ImageFont.truetype(font_manager.findfont(name), size)
