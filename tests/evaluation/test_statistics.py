"""The exact interval against its definition and published values."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from evaluation.statistics import clopper_pearson, summarise


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
    assert summary.interventions == 3 * 200
    assert summary.fallbacks == 3 * 100
    assert summary.reasons == {"because": 300}
    assert summary.violating_episodes == (full_thrust.violating_steps > 0).sum()
    assert summary.decision_p50 == summary.decision_p99 == 0.001
