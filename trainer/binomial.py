"""The exact binomial test: of so many episodes so few were missed that it happens to at most α of them."""

from math import ceil, log, log1p

from scipy.stats import binom

_MOST = 10**15
"""Where counting how many episodes are needed ends."""


def p_value(missed: int, episodes: int, miss_rate: float) -> float:
    """P(at most so many of the episodes are missed), were the probability of a miss just `miss_rate`."""
    return float(binom.cdf(missed, episodes, miss_rate))


def most_missed(episodes: int, miss_rate: float, confidence: float) -> int:
    """How many of the episodes may be missed; -1 if not even 0 may: more of them are needed."""
    allowed = -1
    while allowed < episodes and p_value(allowed + 1, episodes, miss_rate) <= 1.0 - confidence:
        allowed += 1
    return allowed


def least_episodes(miss_rate: float, confidence: float) -> int:
    """The fewest episodes that can show the miss rate, if none of them is missed: (1 − α)^n ≤ δ."""
    n = ceil(min(log(1.0 - confidence) / log1p(-miss_rate), _MOST))
    return n if n == _MOST or most_missed(n, miss_rate, confidence) >= 0 else n + 1
