"""A picture of one robot's decisions over time. It needs matplotlib, which the runtime does not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recorder.timeline import FAULT, Row, Timeline

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]

_INK, _GREY, _PANEL, _UNSAFE = "#1b263b", "#8d99ae", "#f7f8fa", "#f6bdc0"
_RISK, _BARRIER, _THRUST, _TURN = "#7b2cbf", "#0077b6", "#d62839", "#2a9d8f"
MODES = {
    "nominal": "#cfe8e4",
    "guided": "#4cc9f0",
    "filtered": "#f48c06",
    "fallback": "#1b263b",
    FAULT: "#d00000",
}
"""Colours of what became of the nominal action."""
CAUSES = {
    "risk": "#7b2cbf",
    "dwell": "#cdb4e6",
    "barrier": "#70a80b",
    "always": "#0077b6",
    "novelty": "#e85d9f",
    "fault": "#000000",
}
"""Colours of what opened the gate."""
_PAUSE = 0.5
"""A longer silence is not drawn through [s]."""


def draw(
    path: Path, timeline: Timeline, robot: int, title: str, largest: Sequence[float] = (1.0, 1.0)
) -> None:
    """Draws λ against its threshold, the barrier, what became of the actions, and the actions.

    Args:
        path: the PNG to write.
        timeline: the recording.
        robot: whose decisions.
        title: a line above, or two.
        largest: thrust and turn: actions are drawn as shares of these.

    Raises:
        ImportError: if there is no matplotlib.
        OSError: if the file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [row for row in timeline.rows if row.robot == robot]
    seconds = np.array([timeline.seconds(row) for row in rows])
    with rc_context({"font.size": 9.5, "axes.edgecolor": _GREY, "text.color": _INK, "axes.labelcolor": _INK}):
        figure = Figure(figsize=(11.0, 7.2), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=11, fontweight="bold", x=0.01, ha="left")
        axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.2, 1.2, 0.6, 1.4))
        _draw_risk(axes[0], seconds, rows)
        _draw_barrier(axes[1], seconds, rows)
        _draw_ribbons(axes[2], seconds, rows)
        _draw_actions(axes[3], seconds, rows, largest)
        for one in axes:
            one.set_facecolor(_PANEL)
            for side in ("top", "right"):
                one.spines[side].set_visible(False)
            if seconds[0] < 0.0 < seconds[-1]:
                one.axvline(0.0, color=_INK, lw=0.9, ls=":")
        axes[3].set_xlabel("time [s]")
        axes[3].margins(x=0.005)
        figure.savefig(path, dpi=130, format="png")


def _line(axes: Axes, seconds: FloatArray, values: list[float], **style: Any) -> None:
    """A line that breaks where nothing was asked for a while."""
    breaks = np.flatnonzero(np.diff(seconds) > _PAUSE) + 1
    dots: dict[str, Any] = {"marker": ".", "ms": 3} if len(seconds) - len(breaks) < 3 else {}
    axes.plot(
        np.insert(seconds, breaks, np.nan), np.insert(np.array(values), breaks, np.nan), **dots, **style
    )


def _draw_risk(axes: Axes, seconds: FloatArray, rows: list[Row]) -> None:
    _line(axes, seconds, [row.risk for row in rows], color=_RISK, lw=1.3, label="risk score λ")
    threshold: dict[str, Any] = {"color": _INK, "lw": 0.9, "ls": (0, (4, 3)), "label": "threshold"}
    _line(axes, seconds, [row.threshold for row in rows], **threshold)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("λ")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8.5)


def _draw_barrier(axes: Axes, seconds: FloatArray, rows: list[Row]) -> None:
    values = [row.barrier for row in rows]
    _line(axes, seconds, values, color=_BARRIER, lw=1.3)
    known = [value for value in values if np.isfinite(value)]
    low, high = min(known, default=0.0), max(known, default=0.0)
    axes.set_ylim(min(-0.05, low - 0.05), max(0.2, high + 0.05))
    axes.axhspan(axes.get_ylim()[0], 0.0, color=_UNSAFE, alpha=0.6, lw=0)
    axes.set_ylabel("barrier [m]")


def _draw_ribbons(axes: Axes, seconds: FloatArray, rows: list[Row]) -> None:
    """Two lanes: what became of the action, and what opened the gate."""
    from matplotlib.patches import Patch

    ends = np.append(seconds[1:], seconds[-1] + 0.02)
    ends = np.minimum(ends, seconds + _PAUSE)
    patches = []
    lanes = ((1.0, [row.mode for row in rows], MODES), (0.0, [row.opened_by for row in rows], CAUSES))
    for lane, texts, colours in lanes:
        for text, colour in colours.items():
            spans = [(seconds[k], ends[k] - seconds[k]) for k, it in enumerate(texts) if it == text]
            if spans:
                axes.broken_barh(spans, (lane + 0.1, 0.8), color=colour, lw=0)
                patches.append(Patch(color=colour, label=text if lane else f"gate: {text}"))
    axes.set_yticks([0.5, 1.5], ["gate", "mode"])
    axes.set_ylim(0.0, 2.0)
    axes.legend(handles=patches, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8.5)


def _draw_actions(axes: Axes, seconds: FloatArray, rows: list[Row], largest: Sequence[float]) -> None:
    for place, (name, colour) in enumerate((("thrust", _THRUST), ("turn", _TURN))):
        sent = [row.action[place] / largest[place] for row in rows]
        _line(axes, seconds, sent, color=colour, lw=1.4, label=f"{name}, sent")
        nominal: dict[str, Any] = {
            "color": colour,
            "lw": 0.8,
            "ls": (0, (2, 2)),
            "label": f"{name}, the policy's",
        }
        _line(axes, seconds, [row.nominal[place] / largest[place] for row in rows], **nominal)
    axes.set_ylim(-1.1, 1.1)
    axes.set_ylabel("action, share")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8.5)
