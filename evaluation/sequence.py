"""Fixed-sequence testing: hypotheses in an order, until one is not rejected; no correction is needed.

Angelopoulos et al., *Learn then Test*, 2021, section 2.3: where the order was fixed before, the probability
that any true hypothesis is rejected is at most δ, since it would have to be the first true one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from scipy.stats import binom

Candidate = TypeVar("Candidate")


def p_value(missed: int, episodes: int, miss_rate: float) -> float:
    """P(at most so many of the episodes are missed), were the probability of a miss just `miss_rate`."""
    return float(binom.cdf(missed, episodes, miss_rate))


def most_missed(episodes: int, miss_rate: float, confidence: float) -> int:
    """How many of the episodes may be missed; -1 if not even 0 may: more of them are needed."""
    allowed = -1
    while allowed < episodes and p_value(allowed + 1, episodes, miss_rate) <= 1.0 - confidence:
        allowed += 1
    return allowed


def last_to_pass(candidates: Sequence[Candidate], passes: Callable[[Candidate], bool]) -> Candidate | None:
    """The last candidate before the first that does not pass, or None; none is tried after that one."""
    chosen = None
    for candidate in candidates:
        if not passes(candidate):
            break
        chosen = candidate
    return chosen
