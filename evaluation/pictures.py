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
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from decision import Mode, OpenedBy
from evaluation.closed_loop import FloatArray, TextArray, Trajectory
from pointgoal.observation import HAZARD_RADIUS
from pointgoal.scene import STEP_SECONDS
from pointgoal.simulation import GOAL_RADIUS

_INK, _GREY, _PAPER, _PANEL = "#1b263b", "#8d99ae", "#ffffff", "#f7f8fa"
_HAZARD, _HAZARD_EDGE = "#f6bdc0", "#d62839"
_GOAL, _VIOLATION = "#2a9d8f", "#d00000"
_SENT = {Mode.FILTERED: "#f48c06", Mode.GUIDED: "#4cc9f0", Mode.FALLBACK: "#1b263b"}
"""Of what was sent in place of the nominal action."""
_CAUSES = {
    OpenedBy.RISK: "#7b2cbf",
    OpenedBy.DWELL: "#cdb4e6",
    OpenedBy.BARRIER: "#70a80b",
    OpenedBy.ALWAYS: "#0077b6",
    OpenedBy.NOVELTY: "#d62828",
    OpenedBy.FAULT: "#000000",
}
"""Of what opened the gate."""
_GATE_COLOURS = {"off": "#8d99ae", "risk": "#7b2cbf", "always": "#0077b6"}
_GATE_NAMES = {
    "off": "gate off: no filter",
    "risk": "gate risk: where λ or the barrier asks",
    "always": "gate always",
}
_GATE_LINES = {"off": "-", "risk": "-", "always": (0, (3, 1.5))}
"""Gates that decide alike draw over one another: the later one is dashed."""
_RISK_COLOURS = LinearSegmentedColormap.from_list("risk", ["#c3bfd0", "#9d4edd", "#240046"])
_TRAIL, _GOAL_PALE = "#9fb3c8", "#cfe8e4"
_SIDE, _GUTTER, _STRIP, _SHARP = 360, 14, 44, 2
"""Of the animation [pixels]: a panel's side, the gap, the words above; and how much finer it is drawn."""
_FRAME_MILLISECONDS, _LAST_MILLISECONDS = 50, 2000
_ROBOT_RADIUS = 0.1
_PANEL_INCHES, _GAP_INCHES, _LEFT_INCHES, _RIGHT_INCHES = 3.95, 0.2, 1.3, 1.05
_ROWS = (("", 0.95), ("λ", 0.95), ("barrier [m]", 0.95), ("depth cost so far", 0.95))
"""Of what happened over time: the label of each row, and its height [inches]."""
_APART = 0.05
"""Two robots that were at one place have parted once they are this far from each other [m]."""


@dataclass(frozen=True)
class Drive:
    """One episode of one robot.

    Attributes:
        pose: [T, 3] x, y [m], heading [rad].
        goal: [T, 2] [m].
        risk: [T] λ_ξ(s).
        mode: [T] texts of `Mode`: what became of the nominal action.
        opened_by: [T] texts of `OpenedBy`, "" where the gate was closed.
        barrier: [T] h [m].
        cost: [T].
        reward: [T].
        hazards: [n, 2] [m].
    """

    pose: FloatArray
    goal: FloatArray
    risk: FloatArray
    mode: TextArray
    opened_by: TextArray
    barrier: FloatArray
    cost: FloatArray
    reward: FloatArray
    hazards: FloatArray

    @property
    def caption(self) -> str:
        """Return, cost and violating steps in words; below, how often something else was sent."""
        return (
            f"return {self.reward.sum():.1f}   depth cost {self.cost.sum():.2f}   "
            f"{(self.cost > 0).sum()} violating steps\n"
            f"{(self.mode != Mode.NOMINAL).mean():.0%} of the policy's actions replaced"
        )


def drive(trajectory: Trajectory, episode: int) -> Drive:
    """One episode out of a recording, up to its end."""
    running = np.isfinite(trajectory.cost[:, episode])
    return Drive(
        pose=trajectory.pose[running, episode],
        goal=trajectory.goal[running, episode],
        risk=trajectory.risk[running, episode],
        mode=trajectory.mode[running, episode],
        opened_by=trajectory.opened_by[running, episode],
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
        inner = len(drives) * _PANEL_INCHES + (len(drives) - 1) * _GAP_INCHES
        width = _LEFT_INCHES + inner + _RIGHT_INCHES
        below = 0.5 + sum(height + 0.17 for _, height in _ROWS)
        height = below + 0.7 + _PANEL_INCHES + 1.45
        figure = Figure(figsize=(width, height), facecolor=_PAPER)
        FigureCanvasAgg(figure)
        lefts = [(_LEFT_INCHES + k * (_PANEL_INCHES + _GAP_INCHES)) / width for k in range(len(drives))]
        figure.text(lefts[0], 1.0 - 0.38 / height, title, fontsize=15, fontweight="bold")
        colours = Normalize(
            0.0, max(1e-9, *(float(np.nanpercentile(one.risk, 99)) for one in drives.values()))
        )
        window, parted = _window(drives), _parted(drives)
        for left, (gate, one) in zip(lefts, drives.items(), strict=True):
            box = (left, (below + 0.7) / height, _PANEL_INCHES / width, _PANEL_INCHES / height)
            axes = figure.add_axes(box)
            _draw_path(axes, one, colours, window)
            if parted is not None and gate in parted.gates:
                x, y = one.pose[parted.step, :2]
                axes.scatter(x, y, s=70, marker="x", color=_INK, linewidths=1.8, zorder=5)
            name = _GATE_NAMES.get(gate, gate)
            axes.set_title(name, loc="left", fontweight="bold", color=_GATE_COLOURS.get(gate, _INK))
            caption = one.caption
            if parted is None and gate == "always" and "risk" in drives:
                caption += "; the same way as with gate risk"
            axes.text(0.0, -0.025, caption, transform=axes.transAxes, va="top", fontsize=8.5)
        _legend(figure, colours, lefts[0], 1.0 - 0.78 / height, parted is not None)
        rows, bottom = [], below
        for label, tall in _ROWS:
            bottom -= tall + 0.17
            axes = figure.add_axes((lefts[0], (bottom + 0.17) / height, inner / width, tall / height))
            axes.set_ylabel(label)
            axes.yaxis.set_label_coords(-0.04, 0.5)
            rows.append(axes)
        _draw_over_time(rows, drives, threshold, parted)
        figure.savefig(path, dpi=130)


@dataclass(frozen=True)
class _Parted:
    """The step from which on the robots of two gates went different ways."""

    gates: tuple[str, str]
    step: int


def _parted(drives: Mapping[str, Drive]) -> _Parted | None:
    """When the gates `risk` and `always` first led to different places, if they did."""
    if "risk" not in drives or "always" not in drives:
        return None
    risk, always = drives["risk"].pose, drives["always"].pose
    count = min(len(risk), len(always))
    apart = np.hypot(*(risk[:count, :2] - always[:count, :2]).T) > _APART
    return _Parted(("risk", "always"), int(np.argmax(apart))) if apart.any() else None


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
    segments = list(np.concatenate([points[:-1], points[1:]], axis=1))
    # What was sent lies under the line as a broad band, so that λ can be read on it.
    for mode, colour in _SENT.items():
        band = [segments[k] for k in np.flatnonzero(one.mode[:-1] == mode)]
        axes.add_collection(LineCollection(band, colors=colour, linewidths=6.5, alpha=0.75, zorder=2))
    widths = np.where(one.opened_by[:-1] == "", 0.9, 2.2)
    lines = LineCollection(segments, cmap=_RISK_COLOURS, norm=colours, linewidths=widths, zorder=3)
    lines.set_array(one.risk[:-1])
    axes.add_collection(lines)
    hurt = one.cost > 0.0
    axes.scatter(one.pose[hurt, 0], one.pose[hurt, 1], s=11.0, color=_VIOLATION, linewidths=0, zorder=4)
    axes.scatter(
        one.pose[0, 0], one.pose[0, 1], s=46, facecolor=_PAPER, edgecolor=_INK, linewidths=1.6, zorder=5
    )


def _goals_met(one: Drive) -> FloatArray:
    """The goals of an episode [k, 2], in order."""
    fresh = np.ones(len(one.goal), dtype=bool)
    fresh[1:] = (one.goal[1:] != one.goal[:-1]).any(axis=1)
    return one.goal[fresh]


def _legend(figure: Figure, colours: Normalize, left: float, bottom: float, parted: bool) -> None:
    """What lines, bands and signs mean, in two lines from a place down [shares of the figure]."""
    width, height = figure.get_size_inches()
    highest = float(colours.vmax or 1.0)
    strip = figure.add_axes((left, bottom, 1.2 / width, 0.11 / height))
    gradient = np.linspace(0.0, 1.0, 256)[None]
    strip.imshow(gradient, aspect="auto", cmap=_RISK_COLOURS, extent=(0.0, 1.0, 0.0, 1.0))
    strip.set_axis_off()
    figure.text(left + 1.28 / width, bottom, f"risk score λ along the path, 0 to {highest:.2g}", fontsize=9)
    marks: list[tuple[str, Any]] = [
        ("gate closed", Line2D([], [], color=_INK, lw=0.9)),
        ("gate open", Line2D([], [], color=_INK, lw=2.2)),
        ("start", _dot(_PAPER, _INK)),
        ("goal", _dot(_GOAL_PALE, _GOAL)),
        ("hazard", _dot(_HAZARD, _HAZARD_EDGE)),
        ("inside a hazard: a violation", _dot(_VIOLATION, _VIOLATION)),
    ]
    if parted:
        cross = Line2D([], [], ls="", marker="x", color=_INK, markersize=7, markeredgewidth=1.8)
        marks.append(("here risk and always part", cross))
    sent = [
        ("the filter's action (filtered)", Mode.FILTERED),
        ("the guide's (guided)", Mode.GUIDED),
        ("nothing certified: the plan, or least harm (fallback)", Mode.FALLBACK),
    ]
    bands: list[tuple[str, Any]] = [
        (words, Line2D([], [], color=_SENT[mode], lw=6.5, alpha=0.75)) for words, mode in sent
    ]
    figure.text(left, bottom - 0.28 / height, "sent in place of the policy's action:", fontsize=9)
    for entries, inches, up in ((marks, 4.0, 0.055), (bands, 2.3, -0.225)):
        figure.legend(
            [mark for _, mark in entries],
            [words for words, _ in entries],
            loc="center left",
            bbox_to_anchor=(left + inches / width, bottom + up / height),
            ncols=len(entries),
            frameon=False,
            fontsize=9,
            columnspacing=1.3,
            handletextpad=0.8,
            handlelength=1.4,
        )


def _dot(face: str, edge: str) -> Line2D:
    return Line2D([], [], ls="", marker="o", markersize=7, color=face, markeredgecolor=edge)


def _draw_over_time(
    rows: list[Axes], drives: Mapping[str, Drive], threshold: float, parted: _Parted | None
) -> None:
    gate_row, risk, barrier, cost = rows
    _draw_gates(gate_row, {gate: one for gate, one in drives.items() if (one.opened_by != "").any()})
    for gate, one in drives.items():
        seconds = np.arange(len(one.cost)) * STEP_SECONDS
        style: dict[str, Any] = {
            "color": _GATE_COLOURS.get(gate, _INK),
            "ls": _GATE_LINES.get(gate, "-"),
            "lw": 1.5,
        }
        risk.plot(seconds, one.risk, label=f"gate {gate}", **style)
        barrier.plot(seconds, one.barrier, **style)
        cost.plot(seconds, np.cumsum(one.cost), **style)
    risk.set_ylim(bottom=0.0)
    risk.axhline(threshold, color=_INK, lw=0.9, ls=(0, (4, 3)))
    # Beside the axes, where no curve can be.
    across = risk.get_yaxis_transform()
    risk.text(1.006, threshold, f"threshold\n{threshold:.2g}", va="center", fontsize=8, transform=across)
    barrier.axhspan(-9.0, 0.0, color=_HAZARD, alpha=0.6, lw=0)
    barrier.set_ylim(-0.12, 0.8)
    across = barrier.get_yaxis_transform()
    barrier.text(1.006, -0.06, "below 0:\nnot safe", va="center", fontsize=8, transform=across)
    last = max(len(one.cost) for one in drives.values()) * STEP_SECONDS
    for axes in rows:
        axes.set_xlim(0.0, last)
        axes.set_facecolor(_PANEL)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.tick_params(labelbottom=axes is cost, labelsize=8.5)
        if parted is not None:
            axes.axvline(parted.step * STEP_SECONDS, color=_INK, lw=0.9, ls=":")
    if parted is not None:
        gate_row.text(
            parted.step * STEP_SECONDS, 1.02, "×", transform=gate_row.get_xaxis_transform(), ha="center"
        )
    cost.set_xlabel("time [s]", labelpad=1)
    # Beside the axes too: a cost may be anywhere.
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.05)}
    cost.legend(*risk.get_legend_handles_labels(), frameon=False, fontsize=8, handlelength=1.4, **place)


def _draw_gates(axes: Axes, drives: Mapping[str, Drive]) -> None:
    """Two lanes for each gate that opened: what opened it, and below what was sent in the action's place."""
    ticks, seen = [], set()
    for k, (gate, one) in enumerate(drives.items()):
        top = 2.4 * (len(drives) - 1 - k)
        for lane, texts, colours in (
            (top + 1.0, one.opened_by, _CAUSES),
            (top, one.mode, _SENT),
        ):
            axes.broken_barh([(0.0, len(texts) * STEP_SECONDS)], (lane, 0.9), facecolor="#e9ecf1", lw=0)
            for text, colour in colours.items():
                spans = _spans(texts == text)
                # The edge keeps a single step from being too narrow to be seen.
                axes.broken_barh(spans, (lane, 0.9), facecolor=colour, edgecolor=colour, lw=0.5)
                if spans and colours is _CAUSES:
                    seen.add(text)
        ticks += [(top + 1.45, f"{gate}: opened by"), (top + 0.45, "sent")]
    axes.set_yticks([height for height, _ in ticks], [words for _, words in ticks])
    axes.set_ylim(-0.1, 2.4 * max(len(drives), 1) - 0.4)
    axes.tick_params(axis="y", length=0)
    names = {OpenedBy.DWELL: "it stayed open", OpenedBy.BARRIER: "barrier alone"}
    marks = [Line2D([], [], color=_CAUSES[cause], lw=6.5) for cause in _CAUSES if cause in seen]
    words = [names.get(cause, str(cause)) for cause in _CAUSES if cause in seen]
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.05)}
    axes.legend(marks, words, frameon=False, fontsize=8, handlelength=0.7, handletextpad=0.9, **place)


def _spans(mask: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """The runs of True as (start, length) [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(float(a) * STEP_SECONDS, float(b - a) * STEP_SECONDS) for a, b in edges.reshape(-1, 2)]


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
            colour = _VIOLATION if one.cost[k] > 0 else _SENT.get(Mode(one.mode[k]), _TRAIL)
            self._pen.line(ends, fill=colour, width=(4 if colour != _TRAIL else 2) * _SHARP)
        self._drawn = now
        picture = self._floor.copy()
        pen = ImageDraw.Draw(picture)
        self._circle(pen, one.goal[now], GOAL_RADIUS, fill=_GOAL_PALE, outline=_GOAL, width=2 * _SHARP)
        recent = slice(max(0, now - stride + 1), now + 1)
        hurt = (one.cost[recent] > 0).any()
        acted = [mode for mode in _SENT if (one.mode[recent] == mode).any()]
        body = _VIOLATION if hurt else _SENT[acted[0]] if acted else _INK
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
        *_SENT.values(),
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
