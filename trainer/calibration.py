"""The threshold on λ above which the gate opens, from closed-loop episodes.

Whole episodes are scored, not steps, for the steps of an episode are not exchangeable. The score S of an
episode with violations is the smallest λ in the lead time before each of them begins: a threshold below S
has the gate open all the time that the filter needs, every time. (The largest λ before the first violation,
the weaker score, is reached in passing a hazard well, and leaves the gate closed when it counts: a filter
that acts too late does worse than none.) Of n such episodes, with scores S_(1) ≤ … ≤ S_(n), the threshold
S_(k) misses a new violating episode with probability at most α, with confidence 1 − δ, when BinomCDF(k − 1;
n, α) ≤ δ (the order statistic's exact law). The filter changes the states that are visited, so this says
nothing of the closed loop with the filter in it: `lagnet-evaluate --gate risk` measures that.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
import numpy.typing as npt

from pointgoal.scene import STEP_SECONDS

LEAD = 0.6
"""Lead time the filter needs [s]: to turn, and to stop from top speed."""
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
        [n], in the episodes' order; −∞ where a violation begins before the lead time has passed.
    """
    lead = round(LEAD / STEP_SECONDS)
    found = []
    for episode in range(cost.shape[1]):
        violating = cost[:, episode] > 0
        begins = np.flatnonzero(violating & ~np.r_[False, violating[:-1]])
        if begins.size:
            windows = [multiplier[max(0, begin - lead) : begin + 1, episode].min() for begin in begins]
            found.append(float(min(windows)) if begins[0] >= lead else -np.inf)
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
            0.0, f"gate always open: λ was not above 0 for {LEAD} s ahead in {k} of {n} violating episodes"
        )
    return Threshold(
        value,
        f"exact binomial: open for {LEAD} s ahead of every violation in all but {MISS:.0%} of violating "
        f"episodes, confidence {1 - DOUBT:.0%}, from {n} violating of {cost.shape[1]} episodes (rank {k})",
    )
