"""Tables of evaluations; readable in 100 columns."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console, Group
from rich.table import Table

from command import terminal
from decision import OpenedBy, Origin
from evaluation.statistics import Summary

TABLE_WIDTH = 100
"""Columns that the tables fit."""
_STYLE: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
_CAUSES = {
    OpenedBy.ALWAYS: "it always is",
    OpenedBy.RISK: "by risk",
    OpenedBy.DWELL: "it stayed open",
    OpenedBy.BARRIER: "by barrier alone",
    OpenedBy.NOVELTY: "by novelty",
    OpenedBy.FAULT: "by fault",
}
_ORIGINS = {
    Origin.BARRIER: "barrier: the QP",
    Origin.CIRCULATION: "circulation: the QP turns along",
    Origin.SEARCH: "search",
    Origin.GUIDE: "guide",
    Origin.PLAN: "plan (fallback)",
    Origin.HARM: "least harm (fallback)",
}


def table_console() -> Console:
    """Where tables are printed: as wide as the terminal, or `TABLE_WIDTH` where there is none."""
    width = None if sys.stdout.isatty() else TABLE_WIDTH
    return terminal(stderr=False, width=width)


def tables(title: str, summaries: Mapping[str, Summary]) -> Group:
    """What became of the robots, a row a label; and why gate and filter acted, a column a label."""
    return Group(outcomes(title, summaries), actions(summaries))


def outcomes(title: str, summaries: Mapping[str, Summary]) -> Table:
    """Return, costs, violations and decision time, one row for each of label → figures."""
    table = Table(title=title, title_justify="left", title_style="bold", **_STYLE)
    table.add_column("", no_wrap=True)
    for name in (
        "return\nmean ± std",
        "return\np10",
        "depth cost\nan episode",
        "indicator\nan episode",
        "violating\nepisodes",
        "95 %\ninterval",
        "decision [µs]\np50 / p99",
    ):
        table.add_column(name, justify="right")
    for label, s in summaries.items():
        table.add_row(
            label,
            f"{s.return_mean:.2f} ± {s.return_std:.2f}",
            f"{s.return_p10:.2f}",
            _number(s.cost_mean),
            f"{s.indicator_cost_mean:.2f}",
            f"{s.violating_episodes} of {s.episodes}",
            f"{100.0 * s.violation_low:.1f}–{100.0 * s.violation_high:.1f} %",
            f"{s.decision_p50 * 1e6:.0f} / {s.decision_p99 * 1e6:.0f}",
        )
    return table


def actions(summaries: Mapping[str, Summary]) -> Table:
    """Shares of steps: gate open, by cause; interventions, by origin. What never happened is left out."""
    table = Table(**_STYLE)
    table.add_column("share of steps", no_wrap=True)
    for label in summaries:
        table.add_column(label, justify="right", no_wrap=True)
    every = list(summaries.values())
    table.add_row("gate open", *(_share(s.open_steps, s) for s in every))
    for cause, words in _CAUSES.items():
        if any(s.opened_by[cause] for s in every):
            table.add_row(f"  {words}", *(_share(s.opened_by[cause], s) for s in every))
    table.add_row("interventions", *(_share(s.interventions, s) for s in every))
    for origin, words in _ORIGINS.items():
        if any(s.origins[origin] for s in every):
            table.add_row(f"  {words}", *(_share(s.origins[origin], s) for s in every))
    table.add_row("certified action replaced", *(_share(s.certified_replaced, s) for s in every))
    return table


def _number(value: float) -> str:
    """Three decimals, but never 0 for what is not."""
    return "< 0.001" if 0.0 < value < 0.0005 else f"{value:.3f}"


def _share(count: int, summary: Summary) -> str:
    """A share of all steps; never 0 for what is not."""
    share = count / summary.steps
    if count == 0:
        return "0 %"
    return "< 0.01 %" if share < 0.00005 else f"{100.0 * share:.2f} %"
