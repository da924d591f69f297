"""`lagnet-plot`: learning curves out of progress.csv alone, laid out as in the paper's figures 3 and 4."""

import itertools
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import tyro
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator, NullLocator, StrMethodFormatter
from tyro.conf import Positional

from command import command, settings, terminal, why_not_file
from trainer.curves import Curves, read_curves
from trainer.errors import CheckpointError, ConfigError, TrainerError
from trainer.report import FILE

Floats = npt.NDArray[np.float64]
Band = Literal["range", "deviation"]
Scale = Literal["symlog", "linear"]
SUFFIXES = (".png", ".pdf", ".svg")
UNLIMITED = frozenset({"ppo"})
"""Algorithms that know no cost limit: one curve serves every panel."""

_ROWS = (("return_100", "return"), ("cost_100", "cost return"), ("multiplier", "multiplier λ"))
_BANDS = {"range": "lowest to highest", "deviation": "± one standard deviation"}

_LIMIT = "limit d"
# Told apart by lightness as well as by hue (after Okabe and Ito, and Tol), by dashes where two come close.
_STYLES: dict[str, tuple[str, str | tuple[int, tuple[float, ...]], float]] = {
    "lagnet": ("#d55e00", "-", 2.0),
    "lagnet-foresight": ("#0072b2", "-", 2.0),
    "ppo": ("#555555", (0, (1, 1)), 1.4),
    "ppo-lag": ("#009e73", "-", 1.2),
    "trpo-lag": ("#cc79a7", "-", 1.2),
    "cppo-pid": ("#e69f00", "-", 1.2),
    "ipo": ("#56b4e9", "-", 1.2),
    "cpo": ("#882255", (0, (5, 1.5)), 1.2),
    "scpo": ("#7a7a1f", (0, (5, 1.5)), 1.2),
    _LIMIT: ("#222222", (0, (4, 2)), 1.0),
}
_OTHERS = ("#000000", "#a6761d", "#5e3c99", "#1b7837", "#b2182b")
_INK, _PALE, _GRID = "#222222", "#666666", "#e6e6e6"
_PANEL = 1.75
"""Height of a panel [inch]."""
_WIDTH = {1: 4.0, 2: 3.0}
"""Width of a panel by the number of columns [inch]; 2.25 where there are more."""
_LINE = 0.135
"""Height of a line of labels [inch]."""
_MARGIN = (1.9, 0.75)
"""What the panels leave for labels, to the right and below [inch]."""
_MOST_TICKS = 7
_FONT: Any = {
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


@dataclass(frozen=True)
class Plot:
    """Draws return, cost return and multiplier against environment steps.

    One column for each cost limit, one line for each algorithm: the mean over its seeds, with a band. A run
    that is still going on is drawn as far as it is; a line is paler where it lacks some of its seeds.
    """

    folders: Positional[tuple[Path, ...]]
    """Run folders, or folders of runs such as a sweep's."""
    out: Path = Path("curves.png")
    """Picture to write; its ending says which kind: .png, .pdf or .svg."""
    band: Band = "range"
    """What the bands span: from the lowest to the highest seed, or the mean ± one standard deviation."""
    scale: Scale = "symlog"
    """Axes of cost return and multiplier: linear throughout, or (symlog) linear to 1, logarithmic above."""
    dpi: Annotated[int, tyro.conf.arg(metavar="DOTS")] = 200
    """Dots per inch of a .png."""


@dataclass(frozen=True)
class Average:
    """One figure of several seeds.

    Attributes:
        steps: [P] environment steps.
        mean: [P] over the seeds that have got there.
        low: [P] lower edge of the band.
        high: [P] upper edge of the band.
        complete: [P] whether all seeds have got there.
    """

    steps: Floats
    mean: Floats
    low: Floats
    high: Floats
    complete: npt.NDArray[np.bool_]


def average(runs: Sequence[Curves], column: str, band: Band) -> Average | None:
    """Averages a column over seeds, on all steps at which any of them reports it.

    A seed that reports at other steps than the rest is interpolated linearly, never beyond its own ends.

    Args:
        runs: the seeds.
        column: of progress.csv.
        band: what the band spans.

    Returns:
        The average, or None if no run has reported anything in this column.
    """
    series = []
    for run in runs:
        values = run.columns.get(column)
        if values is not None and (known := np.isfinite(values)).any():
            series.append((run.columns["steps"][known], values[known]))
    if not series:
        return None
    steps = np.unique(np.concatenate([at for at, _ in series]))
    table = np.stack([np.interp(steps, at, values, np.nan, np.nan) for at, values in series])
    # A step between the end of one seed and the start of another belongs to none.
    steps, table = (each[..., np.isfinite(table).any(axis=0)] for each in (steps, table))
    mean = np.nanmean(table, axis=0)
    if band == "range":
        low, high = np.nanmin(table, axis=0), np.nanmax(table, axis=0)
    else:
        deviation = np.nanstd(table, axis=0)
        low, high = mean - deviation, mean + deviation
    begun = np.maximum.accumulate(np.isfinite(table), axis=1)
    complete = np.isfinite(table).all(axis=0) | ~begun.all(axis=0)
    return Average(steps, mean, low, high, complete)


def find_runs(folders: Sequence[Path]) -> list[Curves]:
    """Reads every run in or below the folders that has something to show, in the order of their names.

    Raises:
        ConfigError: if there is none.
        CheckpointError: if one cannot be read.
    """
    found: dict[Path, Curves] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder} is no folder")
        for path in sorted(folder.rglob(FILE)):
            run = read_curves(path.parent)
            if len(run.columns.get("steps", ())):
                found[path.parent.resolve()] = run
    if not found:
        raise ConfigError(f"no run in {', '.join(map(str, folders))} has reported anything yet")
    return list(found.values())


def draw(runs: Sequence[Curves], band: Band = "range", scale: Scale = "symlog") -> Figure:
    """Draws the figure.

    Args:
        runs: at least one.
        band: what the bands span.
        scale: of the axes of cost return and multiplier.

    Returns:
        Rows return, cost return, multiplier; one column for each cost limit.
    """
    limits = sorted({run.cost_limit for run in runs}, key=lambda limit: (limit is None, limit))
    with rc_context(_FONT):
        width = _WIDTH.get(len(limits), 2.25) * len(limits) + _MARGIN[0]
        figure = Figure(figsize=(width, 3 * _PANEL + _MARGIN[1]), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(3, len(limits), sharex=True, sharey="row", squeeze=False)
        last: dict[str, dict[str, Average]] = {}
        for (column, name), row in zip(_ROWS, panels, strict=True):
            for axes, limit in zip(row, limits, strict=True):
                last[column] = _panel(axes, _groups(runs, limit), column, band)
                if column == "cost_100" and limit is not None:
                    colour, dashes, thickness = _style(_LIMIT)
                    axes.axhline(limit, color=colour, linestyle=dashes, linewidth=thickness, zorder=5)
            row[0].set_ylabel(name)
        _scales(panels, limits, scale)
        for (column, _), row in zip(_ROWS, panels, strict=True):
            _labels(row[-1], last[column], limits[-1] if column == "cost_100" else None)
        _key(panels[0, -1], {run.algorithm for run in runs} - set(last["return_100"]))
        caption = textwrap.fill(_caption(runs, band), int(16 * width))
        figure.supxlabel(caption, fontsize=7.5, color=_PALE)
        # Text is laid out when it is drawn: with these fonts, not with those of whoever saves the figure.
        figure.draw_without_rendering()
    return figure


def _groups(runs: Sequence[Curves], limit: float | None) -> dict[str, list[Curves]]:
    """The runs of one panel by algorithm, in the order of the palette."""
    groups: dict[str, list[Curves]] = defaultdict(list)
    for run in runs:
        if run.cost_limit == limit:
            groups[run.algorithm].append(run)
    for run in runs:
        name = run.algorithm
        if name in UNLIMITED and all(other.cost_limit != limit for other in runs if other.algorithm == name):
            groups[name].append(run)
    known = list(_STYLES)
    return dict(sorted(groups.items(), key=lambda item: (item[0] not in known, *_rank(item[0]))))


def _rank(name: str) -> tuple[int, str]:
    known = list(_STYLES)
    return (known.index(name), "") if name in known else (0, name)


def _panel(axes: Axes, groups: dict[str, list[Curves]], column: str, band: Band) -> dict[str, Average]:
    """Draws one panel; returns what it shows, by algorithm."""
    shown: dict[str, Average] = {}
    for name, runs in groups.items():
        curve = average(runs, column, band)
        if curve is None or (column == "multiplier" and not curve.high.any()):
            continue  # without a multiplier: a line along 0 would say that it has one
        shown[name] = curve
        colour, dashes, width = _style(name)
        order = 3 if width > 1.5 else 2
        axes.fill_between(curve.steps, curve.low, curve.high, color=colour, alpha=0.16, linewidth=0, zorder=1)
        axes.plot(curve.steps, curve.mean, color=colour, linestyle=dashes, linewidth=width, alpha=0.4)
        whole = np.where(curve.complete, curve.mean, np.nan)
        axes.plot(curve.steps, whole, color=colour, linestyle=dashes, linewidth=width, zorder=order)
    if not shown:
        axes.text(
            0.5,
            0.5,
            "no multiplier" if column == "multiplier" else "nothing yet",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=_PALE,
        )
    return shown


def _style(name: str) -> tuple[str, str | tuple[int, tuple[float, ...]], float]:
    if name in _STYLES:
        return _STYLES[name]
    return _OTHERS[sum(name.encode()) % len(_OTHERS)], "-", 1.2


def _scales(panels: Any, limits: Sequence[float | None], scale: Scale) -> None:
    """Axes, ticks and titles of the panels [3, columns]."""
    for axes, limit in zip(panels[0], limits, strict=True):
        axes.set_title("cost limit not known" if limit is None else f"cost limit d = {limit}")
    for axes in panels[-1]:
        axes.set_xlabel("environment steps")
    for axes in itertools.chain(*panels):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=_GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(length=2.5, width=0.6)
        axes.margins(x=0.0)
    shared = panels[0, 0]
    shared.set_xlim(left=0)
    shared.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    shared.xaxis.set_major_formatter(EngFormatter(sep=""))
    for row in panels[1:]:
        if scale == "symlog":
            top = row[0].get_ylim()[1]
            for axes in row:
                axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
                axes.set_yticks(_ticks(top))
                axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axes.yaxis.set_minor_locator(NullLocator())
            row[0].set_ylim(top=max(1.05 * top, 1.0))
        row[0].set_ylim(bottom=0)


def _ticks(top: float) -> list[float]:
    """Ticks of a symlog axis that ends at `top`: every 1, 2 and 5, or the powers of ten where those crowd."""
    for digits in ((1, 2, 5), (1,)):
        ticks = [0.0, 0.5, *(d * 10.0**k for k in range(9) for d in digits if d * 10.0**k <= max(top, 1.0))]
        if len(ticks) <= _MOST_TICKS:
            break
    return ticks


def _labels(axes: Axes, shown: dict[str, Average], limit: float | None) -> None:
    """Names the lines beside their ends."""
    ends = [(name, float(curve.steps[-1]), float(curve.mean[-1])) for name, curve in shown.items()]
    if limit is not None:
        ends.append((_LIMIT, axes.get_xlim()[1], limit))
    ends.sort(key=lambda each: each[2])
    to_fraction = axes.transScale + axes.transLimits
    points = [to_fraction.transform(end[1:]) for end in ends]
    places = spread([float(point[1]) for point in points], _LINE / _PANEL, 0.02, 1.0)
    for place, point, (name, *_) in zip(places, points, ends, strict=True):
        colour, _, width = _style(name)
        axes.annotate(
            name,
            xy=(float(point[0]), float(point[1])),
            xytext=(1.09, place),
            xycoords="axes fraction",
            textcoords="axes fraction",
            color=colour,
            fontweight="bold" if width > 1.5 else "normal",
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 0,
                "relpos": (0, 0.5),
            },
        )  # fmt: skip


def _key(axes: Axes, names: set[str]) -> None:
    """Names those lines that other columns alone have."""
    for place, name in zip(itertools.count(1), sorted(names, key=_rank)):
        axes.annotate(
            f"({name})",
            xy=(1.09, 0),
            xytext=(0, -place * _LINE * 72),
            xycoords="axes fraction",
            textcoords="offset points",
            color=_style(name)[0],
            va="center",
            annotation_clip=False,
        )


def spread(heights: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Moves rising heights apart, so that labels do not cover each other.

    Args:
        heights: where the labels belong, in rising order.
        gap: smallest distance between two of them.
        low: smallest height.
        high: largest height; kept rather than `low` where not all of them fit.

    Returns:
        Heights in the same order, each at least `gap` from the next.
    """
    places: list[float] = []
    for height in heights:
        least = places[-1] + gap if places else low
        places.append(max(height, least))
    most = high
    for index in reversed(range(len(places))):
        places[index] = min(places[index], most)
        most = places[index] - gap
    return places


def _caption(runs: Sequence[Curves], band: Band) -> str:
    lines: dict[tuple[str, float | None], list[int | None]] = defaultdict(list)
    for run in runs:
        lines[run.algorithm, run.cost_limit].append(run.seed)
    if max(map(len, lines.values())) == 1:
        return "mean of the last 100 episodes; λ: mean over the epoch's states"
    # Runs of one seed, by two versions or from two machines, are no more seeds than one.
    unlike = all(None not in seeds and len(set(seeds)) == len(seeds) for seeds in lines.values())
    over = f"{_span([len(seeds) for seeds in lines.values()])} {'seeds' if unlike else 'runs'}"
    if not unlike:
        told = [len(set(seeds) - {None}) for seeds in lines.values()]
        over += f" of {_span(told)} {'seed' if max(told) == 1 else 'seeds'}" if min(told) else ""
    return (
        f"mean of the last 100 episodes, averaged over {over}; band: {_BANDS[band]}; "
        "λ: mean over the epoch's states"
    )


def _span(counts: Sequence[int]) -> str:
    """One number where all are alike, else the range."""
    least, most = min(counts), max(counts)
    return f"{most}" if least == most else f"{least} to {most}"


def check_output(path: Path, dpi: int) -> None:
    """Refuses what no picture can be written to; errors as for `save`."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--out {path} must end in one of {', '.join(SUFFIXES)}")
    if dpi < 1:
        raise ConfigError(f"--dpi must be above 0, not {dpi}")
    if why := why_not_file(path):
        raise CheckpointError(f"cannot write {path}: {why}")


def save(figure: Figure, path: Path, dpi: int = 200) -> None:
    """Writes the picture.

    Raises:
        ConfigError: if the ending is none of .png, .pdf, .svg, or the resolution is not above 0.
        CheckpointError: if the file cannot be written.
    """
    check_output(path, dpi)
    try:
        with rc_context(_FONT):
            figure.savefig(path, dpi=dpi)
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error.strerror}") from error


def main() -> None:
    """Console script `lagnet-plot`."""
    with command("lagnet-plot", TrainerError, status=1):
        chosen = settings(Plot, "lagnet-plot")
        check_output(chosen.out, chosen.dpi)
        runs = find_runs(chosen.folders)
        save(draw(runs, chosen.band, chosen.scale), chosen.out, chosen.dpi)
        terminal().print(f"{len(runs)} runs: {chosen.out}")


if __name__ == "__main__":
    main()
