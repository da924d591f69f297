"""The threshold on λ above which the gate opens, from closed-loop episodes.

Whole episodes are scored, not steps, for the steps of an episode are not exchangeable. The score S of an
episode with a violation is the largest λ up to a lead time before its first one: a threshold below S opens
the gate in time. Of n such episodes, with scores S_(1) ≤ … ≤ S_(n), the threshold S_(k) misses a new
violating episode with probability at most α, with confidence 1 − δ, when BinomCDF(k − 1; n, α) ≤ δ (the
order statistic's exact law).
"""

from dataclasses import dataclass
from math import comb

import numpy as np
import numpy.typing as npt

LEAD = 0.4
"""Lead time the filter needs [s]: stopping from top speed takes up to that."""
STEP = 0.02
"""Duration of a control step [s]."""
MISS = 0.05
"""α: largest share of violating episodes that the gate may open too late for."""
DOUBT = 0.05
"""δ: largest probability that the calibration itself is wrong about that."""


@dataclass(frozen=True)
class Threshold:
    """A threshold and how it came about.

    Attributes:
        value: the gate opens where λ is above this.
        source: one sentence for the manifest.
    """

    value: float
    source: str


def scores(multiplier: npt.NDArray[np.floating], cost: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """S of each episode that has a violation.

    Args:
        multiplier: λ before each step [T, E].
        cost: of each step [T, E]; NaN after an episode's end.

    Returns:
        [n], in the episodes' order; −∞ where the first violation came before the lead time had passed.
    """
    lead = round(LEAD / STEP)
    found = []
    for episode in range(cost.shape[1]):
        violations = np.flatnonzero(cost[:, episode] > 0)
        if violations.size:
            early = multiplier[: max(0, violations[0] - lead + 1), episode]
            found.append(float(early.max()) if early.size else -np.inf)
    return np.asarray(found, np.float64)


def rank(n: int, miss: float = MISS, doubt: float = DOUBT) -> int:
    """The largest k with BinomCDF(k − 1; n, miss) ≤ doubt; 0 if there is none."""
    tail, k = 0.0, 0
    while k < n:
        tail += comb(n, k) * miss**k * (1 - miss) ** (n - k)
        if tail > doubt:
            break
        k += 1
    return k


def calibrate(multiplier: npt.NDArray[np.floating], cost: npt.NDArray[np.floating]) -> Threshold:
    """The threshold that the module describes, or 0, which leaves the gate open, if it cannot be promised.

    Args:
        multiplier: λ before each step [T, E].
        cost: of each step [T, E].

    Returns:
        The threshold, just below S_(k), so that an episode that scores S_(k) itself is caught.
    """
    found = np.sort(scores(multiplier, cost))
    n = found.size
    k = rank(n)
    if k == 0:
        needed = next(m for m in range(1, 10_000) if rank(m))
        return Threshold(
            0.0,
            f"gate always open: {n} of {cost.shape[1]} calibration episodes had a violation, "
            f"{needed} are needed",
        )
    value = float(np.nextafter(np.float32(found[k - 1]), np.float32(0)))
    if not np.isfinite(value) or value <= 0:
        return Threshold(
            0.0, f"gate always open: {k} of {n} violating episodes were not announced {LEAD} s ahead"
        )
    return Threshold(
        value,
        f"exact binomial: at most {MISS:.0%} of violating episodes announced later than {LEAD} s ahead, "
        f"confidence {1 - DOUBT:.0%}, from {n} violating of {cost.shape[1]} episodes (rank {k})",
    )
