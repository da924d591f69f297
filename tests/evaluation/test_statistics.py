"""The exact interval against its definition and published values."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.stats import binom

from decision import Mode, OpenedBy, Origin
from evaluation.closed_loop import run_episodes
from evaluation.statistics import clopper_pearson, summarise
from evaluation.tables import TABLE_WIDTH, tables

CAUSES = st.sampled_from(["", *OpenedBy])
MODES = st.one_of(
    st.just((Mode.NOMINAL, "")),
    st.tuples(st.sampled_from([Mode.GUIDED, Mode.FILTERED, Mode.FALLBACK]), st.sampled_from(list(Origin))),
)


@given(trials=st.integers(1, 400), share=st.floats(0.0, 1.0), confidence=st.floats(0.5, 0.999))
def test_the_ends_are_where_the_tails_weigh_half_of_what_is_left(trials, share, confidence) -> None:
    hits = round(share * trials)
    low, high = clopper_pearson(hits, trials, confidence)
    tail = (1.0 - confidence) / 2.0
    assert 0.0 <= low <= hits / trials <= high <= 1.0
    if hits > 0:
        assert binom.sf(hits - 1, trials, low) == pytest.approx(tail, rel=1e-6)
    if hits < trials:
        assert binom.cdf(hits, trials, high) == pytest.approx(tail, rel=1e-6)


def test_known_values() -> None:
    # No event in n trials: the upper end is 1 - 0.025^(1/n).
    assert clopper_pearson(0, 100) == (0.0, pytest.approx(1.0 - 0.025**0.01))
    assert clopper_pearson(10, 10) == (pytest.approx(0.025**0.1), 1.0)
    # Clopper and Pearson 1934 as tabulated: 4 of 20.
    assert clopper_pearson(4, 20) == (pytest.approx(0.0573, abs=1e-4), pytest.approx(0.4366, abs=1e-4))


@pytest.mark.parametrize("numbers", [(0, 0), (-1, 5), (6, 5), (1, 5, 0.0), (1, 5, 1.0), (1, 5, float("nan"))])
def test_numbers_that_have_no_interval(numbers) -> None:
    with pytest.raises(ValueError, match="no binomial interval"):
        clopper_pearson(*numbers)


def test_the_summary_adds_up(full_thrust) -> None:
    summary = summarise(full_thrust)
    assert summary.episodes == 3
    assert summary.steps == 3000
    assert summary.cost_mean == pytest.approx(full_thrust.costs.sum() / 3)
    assert summary.indicator_cost_mean == pytest.approx(summary.violating_steps / 3)
    assert summary.violating_episodes == (full_thrust.violating_steps > 0).sum()
    assert summary.modes["fallback"] == 3 * 100
    assert summary.reasons == {"because": 300}
    assert summary.decision_p50 <= summary.decision_p99
    assert sum(summary.opened_by.values()) == summary.open_steps
    assert sum(summary.origins.values()) == summary.interventions
    assert sum(summary.modes.values()) == summary.steps
    shares = json.loads(json.dumps(summary.to_json(), allow_nan=False))["shares"]
    assert sum(shares["opened_by"].values()) == pytest.approx(shares["open"])
    assert sum(shares["origins"].values()) == pytest.approx(shares["interventions"])
    assert shares["certified_replaced"] == summary.certified_replaced / 3000


@given(says=st.lists(st.tuples(MODES, CAUSES, st.booleans()), min_size=1, max_size=30))
@settings(max_examples=15, deadline=None)
def test_counts_add_up_whatever_was_decided(scripted, says) -> None:
    """By cause to the steps with the gate open, by origin to the interventions."""

    def say(step: int):
        (mode, origin), cause, certified = says[step % len(says)]
        return mode, origin, cause, certified

    summary = summarise(run_episodes("PointGoal0-v0", scripted(says=say), 1))
    assert sum(summary.opened_by.values()) == summary.open_steps
    assert sum(summary.origins.values()) == summary.interventions
    counted = sum(bool(cause) for _, cause, _ in (says[(k + 1) % len(says)] for k in range(1000)))
    assert summary.open_steps == counted


def test_tables_fit_a_hundred_columns_and_lose_nothing(full_thrust) -> None:
    one = summarise(full_thrust)
    wide = replace(one, return_mean=-123.45, violating_episodes=1000, episodes=1000, decision_p99=0.123456)
    console = Console(file=io.StringIO(), width=TABLE_WIDTH)
    console.print(tables("title", {"gate off": wide, "gate risk": one, "gate always": one}))
    text = console.file.getvalue()
    assert "…" not in text
    for words in ("indicator", "1000 of 1000", "by barrier alone", "guide", "certified action replaced"):
        assert words in text
    assert "-123.45" in text
    assert "by fault" not in text


def test_what_happened_is_never_rounded_to_nothing(full_thrust) -> None:
    rare = replace(summarise(full_thrust), steps=10**8, open_steps=1, cost_mean=1e-5, episodes=1000)
    console = Console(file=io.StringIO(), width=TABLE_WIDTH)
    console.print(tables("title", {"gate risk": rare}))
    assert "< 0.01 %" in console.file.getvalue()
    assert "< 0.001" in console.file.getvalue()
