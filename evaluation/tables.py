"""Tables of evaluations."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rich.table import Table

from evaluation.statistics import Summary

_ROWS: tuple[tuple[str, Callable[[Summary], str]], ...] = (
    ("return", lambda s: f"{s.return_mean:.2f} ± {s.return_std:.2f}"),
    ("return p10", lambda s: f"{s.return_p10:.2f}"),
    ("cost", lambda s: f"{s.cost_mean:.3f}"),
    ("violating steps", lambda s: f"{s.violating_steps} of {s.steps}"),
    ("violating episodes", lambda s: f"{s.violating_episodes} of {s.episodes}"),
    ("  95 % interval", lambda s: f"{s.violation_low:.1%} to {s.violation_high:.1%}"),
    ("interventions", lambda s: f"{s.interventions / s.steps:.1%} of steps"),
    ("  fallbacks", lambda s: f"{s.fallbacks} steps"),
    ("decision p50 / p99", lambda s: f"{s.decision_p50 * 1e6:.0f} / {s.decision_p99 * 1e6:.0f} µs"),
)


def summary_table(title: str, summaries: Mapping[str, Summary]) -> Table:
    """One column for each of name → figures."""
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("")
    for name in summaries:
        table.add_column(name, justify="right")
    for label, text in _ROWS:
        table.add_row(label, *(text(summary) for summary in summaries.values()))
    return table
