"""The threshold on λ above which the gate opens, from recorded episodes without a filter: the onset form.

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

import numpy as np
import numpy.typing as npt

from pointgoal.scene import STEP_SECONDS
from trainer.binomial import least_episodes, most_missed

LEAD = 0.6
"""Lead time the filter needs [s]: to turn, and to stop from top speed."""
MISS_RATE = 0.05
"""α: largest share of violating episodes that the gate may open too late for."""
CONFIDENCE = 0.95
"""1 − δ: how sure that has to be."""


@dataclass(frozen=True)
class Threshold:
    """A threshold and how it came about.

    Attributes:
        value: the gate opens where λ is above this; 0, which leaves it open, where nothing can be promised.
        source: one sentence for the manifest.
        scores: S of the violating episodes [n], in their order.
        why_not: why nothing can be promised; None: it can.
    """

    value: float
    source: str
    scores: npt.NDArray[np.float64]
    why_not: str | None = None

    @property
    def missed(self) -> int:
        """How many of the violating episodes the gate opens too late for."""
        return int((self.scores <= self.value).sum())


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


def rank(n: int, miss_rate: float = MISS_RATE, confidence: float = CONFIDENCE) -> int:
    """The largest k with BinomCDF(k − 1; n, α) ≤ δ; 0 if there is none."""
    return most_missed(n, miss_rate, confidence) + 1


def calibrate(
    multiplier: npt.NDArray[np.floating],
    cost: npt.NDArray[np.floating],
    miss_rate: float = MISS_RATE,
    confidence: float = CONFIDENCE,
) -> Threshold:
    """The threshold that the module describes, or 0, which leaves the gate open, if it cannot be promised.

    Args:
        multiplier: λ before each step [T, E].
        cost: of each step [T, E]; NaN after an episode's end.
        miss_rate: α.
        confidence: 1 − δ.

    Returns:
        The threshold, just below S_(k), so that an episode that scores S_(k) itself is caught.
    """
    found = scores(multiplier, cost)
    n = found.size
    k = rank(n, miss_rate, confidence)
    value = float(np.nextafter(np.float32(np.sort(found)[k - 1]), np.float32(0))) if k else 0.0
    if value <= 0.0:
        why = f"λ was not above 0 for {LEAD} s ahead in {k} of {n} violating episodes"
        if k == 0:
            needed = least_episodes(miss_rate, confidence)
            why = f"{n} of {cost.shape[1]} calibration episodes had a violation, {needed} are needed"
        return Threshold(0.0, f"gate always open: {why}", found, why)
    return Threshold(
        value,
        f"exact binomial: open for {LEAD} s ahead of every violation in all but {100 * miss_rate:.4g}% of "
        f"violating episodes, confidence {100 * confidence:.4g}%, from {n} violating of {cost.shape[1]} "
        f"episodes (rank {k})",
        found,
    )
