import numpy as np
import pytest
from scipy.stats import binom

from trainer.binomial import least_episodes, most_missed, p_value
from trainer.calibration import calibrate, rank, scores


@pytest.mark.parametrize("n", [1, 58, 59, 92, 93, 200, 1000])
def test_rank_is_the_largest_the_binomial_law_allows(n):
    allowed = [k for k in range(1, n + 1) if binom.cdf(k - 1, n, 0.05) <= 0.05]
    assert rank(n) == max(allowed, default=0)


@pytest.mark.parametrize("n", [2000, 5000])
def test_many_episodes_are_no_overflow(n):
    assert rank(n, 0.5, 0.95) == max(k for k in range(1, n) if binom.cdf(k - 1, n, 0.5) <= 0.05)


def test_the_published_sample_sizes():
    assert [rank(n) for n in (58, 59, 92, 93)] == [0, 1, 1, 2]


def test_the_score_is_the_least_multiplier_in_the_lead_before_any_violation():
    multiplier = np.tile(np.arange(100.0)[:, None], (1, 4))
    multiplier[60, 2] = 7.0
    cost = np.zeros((100, 4))
    cost[50:60, 0] = cost[90, 0] = 0.1  # 0.6 s are 30 steps: from step 20 on
    cost[5, 1] = 0.1  # before any lead
    cost[50, 2] = cost[70, 2] = 0.1  # the second one's lead has the least
    np.testing.assert_array_equal(scores(multiplier, cost), [20.0, -np.inf, 7.0])


def test_a_violation_without_end_is_one():
    multiplier = np.ones((100, 1))
    multiplier[70:] = 0.0
    cost = np.zeros((100, 1))
    cost[50:] = 0.1
    np.testing.assert_array_equal(scores(multiplier, cost), [1.0])


def test_enough_episodes_give_a_threshold_that_catches_the_worst_of_them():
    rng = np.random.default_rng(0)
    multiplier = np.repeat(rng.uniform(1, 2, (1, 80)), 60, axis=0)
    cost = np.zeros((60, 80))
    cost[40] = 0.01
    threshold = calibrate(multiplier, cost)
    assert threshold.value < multiplier[0].min()
    assert threshold.value == pytest.approx(multiplier[0].min())
    assert "exact binomial" in threshold.source


def test_too_few_violations_leave_the_gate_open():
    threshold = calibrate(np.ones((60, 30)), np.zeros((60, 30)))
    assert threshold.value == 0.0
    assert "always open: 0 of 30" in threshold.source


def test_a_multiplier_that_announces_nothing_leaves_the_gate_open():
    cost = np.zeros((60, 80))
    cost[40] = 0.01
    assert calibrate(np.zeros((60, 80)), cost).value == 0.0


@pytest.mark.parametrize(
    ("violating", "miss_rate", "confidence"), [(93, 0.05, 0.95), (299, 0.01, 0.95), (84, 0.2, 0.8)]
)
def test_the_promise_fails_no_more_often_than_it_says(violating, miss_rate, confidence):
    """A thousand calibrations; with S uniform on [1, 2] a threshold of 1 + x misses with probability x.

    The sizes are such that the exact law all but uses up δ.
    """
    rng = np.random.default_rng(0)
    cost = np.zeros((32, violating + 20))
    cost[31, :violating] = 0.1
    broken = 0
    for _ in range(1000):
        # Those without a violation say much, and it must not count.
        score = np.r_[rng.uniform(1, 2, violating), rng.uniform(0, 9, 20)]
        found = calibrate(np.broadcast_to(score, cost.shape), cost, miss_rate, confidence)
        assert found.why_not is None
        assert found.missed == rank(violating, miss_rate, confidence) - 1
        broken += found.value - 1 > miss_rate
    doubt = 1 - confidence
    exact = p_value(most_missed(violating, miss_rate, confidence), violating, miss_rate)
    assert exact > 0.9 * doubt
    assert binom.ppf(1e-4, 1000, exact) <= broken <= binom.ppf(1 - 1e-4, 1000, doubt)


@pytest.mark.parametrize("miss_rate", [0.5, 0.05, 0.01, 1e-3, 1e-6])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_the_fewest_episodes_that_can_show_it(miss_rate, confidence):
    n = least_episodes(miss_rate, confidence)
    assert most_missed(n, miss_rate, confidence) >= 0
    assert n == 1 or most_missed(n - 1, miss_rate, confidence) == -1


def test_a_promise_that_nothing_can_keep_is_no_crash():
    for miss_rate in (1e-9, 5e-324):
        threshold = calibrate(np.ones((60, 3)), np.full((60, 3), 0.1), miss_rate, 0.95)
        assert "are needed" in threshold.why_not
        assert threshold.value == 0.0
