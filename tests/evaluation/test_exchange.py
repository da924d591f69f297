"""The conformal test martingale: how often it alarms for nothing, and how soon for something."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation import exchange
from evaluation.exchange import Exchangeability, fewest_episodes, silence

RUNS = 1000


def alarms(draw, reference: int, fresh: int, doubt: float, shifted=None) -> list[int | None]:
    """In which episode each of a thousand runs alarmed; `shifted` makes the scores after a change."""
    found = []
    for run in range(RUNS):
        rng = np.random.default_rng(run)
        test = Exchangeability(draw(rng, reference), doubt)
        test._rng = np.random.default_rng(RUNS + run)
        for score in (shifted or draw)(rng, fresh):
            test.add(score)
        found.append(test.alarmed)
    return found


def continuous(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.beta(2.0, 5.0, count)


def tied(rng: np.random.Generator, count: int) -> np.ndarray:
    """Half of them 0, as where the barrier is never low, the rest few numbers."""
    return np.where(rng.random(count) < 0.5, 0.0, np.round(rng.random(count), 1))


@pytest.mark.parametrize(("draw", "reference"), [(continuous, 200), (continuous, 10), (tied, 50)])
def test_false_alarms_are_as_rare_as_they_are_said_to_be(draw, reference: int) -> None:
    doubt = 0.2
    found = alarms(draw, reference, 100, doubt)
    assert 20 < sum(at is not None for at in found) <= doubt * RUNS


def test_it_bets_fairly() -> None:
    """After few episodes, where no rare large value carries the mean, that is 1."""
    values = []
    for run in range(20_000):
        rng = np.random.default_rng(run)
        test = Exchangeability(tied(rng, 5))
        test._rng = rng
        values.append([test.add(score) for score in tied(rng, 3)][-1])
    assert np.mean(values) == pytest.approx(1.0, abs=5 * np.std(values) / np.sqrt(len(values)))


@pytest.mark.parametrize(
    ("shifted", "reference", "within"),
    [
        (lambda rng, n: 1.0 + rng.random(n), 200, 8),  # beyond all that was seen
        (lambda rng, n: np.zeros(n), 200, 8),  # silent for another reason
        (lambda rng, n: 1.0 + rng.random(n), 59, 9),  # with the fewest scores that α = δ = 5 % can do with
        (lambda rng, n: rng.beta(4.0, 5.0, n), 200, 40),  # 0.44 on average instead of 0.29
    ],
)
def test_a_shift_is_told_within_so_many_episodes(shifted, reference: int, within: int) -> None:
    found = alarms(continuous, reference, within, 0.05, shifted)
    assert sum(at is not None for at in found) >= 0.95 * RUNS
    assert min(at for at in found if at is not None) >= fewest_episodes(0.05) == 7


def test_a_shift_is_told_that_comes_late_and_an_alarm_stays() -> None:
    rng = np.random.default_rng(0)
    test = Exchangeability(continuous(rng, 200))
    for score in continuous(rng, 300):
        test.add(score)
    assert test.alarmed is None
    for score in 1.0 + rng.random(40):
        test.add(score)
    assert test.alarmed is not None
    at, largest = test.alarmed, test.largest
    assert 300 < at <= 320
    # However far beyond any number it goes.
    for score in [*(2.0 + rng.random(3000)), *continuous(rng, 300)]:
        test.add(score)
        assert np.isfinite(test.value)
    assert (test.alarmed, test.episodes) == (at, 3640)
    assert test.largest >= largest >= test.bound == pytest.approx(20.0)


@given(
    scores=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60),
    reference=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20),
)
def test_the_value_is_the_simple_jumpers(scores, reference) -> None:
    """As written down by Vovk et al., without shares and logarithms; the reference's order does not count."""
    rng = exchange.seeds.generator(exchange.Use.EXCHANGE, 0)
    bag, wealth = list(reference), np.full(5, 0.2)
    test = Exchangeability(reversed(reference))
    for score in scores:
        larger, equal = sum(s > score for s in bag), sum(s == score for s in bag)
        p = (larger + rng.random() * (equal + 1)) / (len(bag) + 1)
        bag.append(score)
        wealth = 0.99 * wealth + 0.01 * wealth.sum() / 5
        wealth = wealth * (1.0 + np.array([-2, -1, 0, 1, 2]) * (p - 0.5))
        assert test.add(score) == pytest.approx(wealth.sum(), rel=1e-9)


def test_what_is_no_score_is_refused() -> None:
    for reference in ([], [0.5, np.nan], [np.inf]):
        with pytest.raises(ValueError, match="reference"):
            Exchangeability(reference)
    for doubt in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="doubt"):
            Exchangeability([0.5], doubt)
    test = Exchangeability([0.5])
    for score in (np.nan, np.inf):
        with pytest.raises(ValueError, match="score"):
            test.add(score)
    assert (test.episodes, test.value) == (0, 1.0)


def test_silence_by_hand() -> None:
    risk = np.array([[0.0, 3.0, 1.0], [1.0, 0.25, 0.0]])
    counts = np.array([[False, True, False], [True, True, False]])
    np.testing.assert_allclose(silence(risk, counts), [0.5, 0.8, 0.0])
    assert silence(np.array([1.0, 3.0]), np.array([True, True])) == 0.5


def test_it_needs_numpy_alone() -> None:
    script = """
import sys
for name in ("torch", "mujoco", "scipy", "onnxruntime", "pydantic", "matplotlib"):
    sys.modules[name] = None  # an import of it now raises ImportError
from evaluation.exchange import Exchangeability
print(Exchangeability([0.5]).add(0.25) > 0.0)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "True"
