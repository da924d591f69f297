"""What a set of episodes says: means, counts, and how sure the rate of violating episodes is."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from evaluation.closed_loop import Episodes
from filter import Mode

CONFIDENCE = 0.95
"""Confidence of the interval of the rate of violating episodes."""


@dataclass(frozen=True)
class Summary:
    """The figures of a set of episodes.

    Attributes:
        episodes: how many.
        return_mean: mean return.
        return_std: standard deviation of the return.
        return_p10: the return that 90 % of the episodes exceed.
        cost_mean: mean cost of an episode.
        violating_steps: steps with a cost above 0, in all episodes.
        violating_episodes: episodes with at least one.
        violation_rate: their share.
        violation_low: lower end of its exact 95 % interval.
        violation_high: upper end.
        steps: steps in all episodes.
        interventions: steps on which the action sent was not the nominal one.
        fallbacks: those of them on which it was a fallback.
        decision_p50: median of the decision time [s].
        decision_p99: 99th percentile of the decision time [s].
        reasons: reason → fallbacks that gave it; the ten most frequent.
    """

    episodes: int
    return_mean: float
    return_std: float
    return_p10: float
    cost_mean: float
    violating_steps: int
    violating_episodes: int
    violation_rate: float
    violation_low: float
    violation_high: float
    steps: int
    interventions: int
    fallbacks: int
    decision_p50: float
    decision_p99: float
    reasons: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """The figures as plain JSON."""
        return asdict(self)


def summarise(episodes: Episodes) -> Summary:
    """The figures of a set of episodes."""
    violating = int((episodes.violating_steps > 0).sum())
    count = len(episodes.returns)
    low, high = clopper_pearson(violating, count)
    p50, p99 = np.percentile(episodes.seconds, [50, 99])
    return Summary(
        episodes=count,
        return_mean=float(episodes.returns.mean()),
        return_std=float(episodes.returns.std()),
        return_p10=float(np.percentile(episodes.returns, 10)),
        cost_mean=float(episodes.costs.mean()),
        violating_steps=int(episodes.violating_steps.sum()),
        violating_episodes=violating,
        violation_rate=violating / count,
        violation_low=low,
        violation_high=high,
        steps=int(episodes.steps.sum()),
        interventions=int(episodes.modes[:, Mode.FILTERED].sum() + episodes.modes[:, Mode.FALLBACK].sum()),
        fallbacks=int(episodes.modes[:, Mode.FALLBACK].sum()),
        decision_p50=float(p50),
        decision_p99=float(p99),
        reasons=dict(Counter(episodes.reasons).most_common(10)),
    )


def clopper_pearson(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The exact interval of a binomial rate (Clopper and Pearson 1934).

    Args:
        hits: trials with the event, 0 to `trials`.
        trials: how many, at least 1.
        confidence: in (0, 1).

    Returns:
        Lower and upper end.

    Raises:
        ValueError: if the numbers are not such.
    """
    if not (trials >= 1 and 0 <= hits <= trials and 0.0 < confidence < 1.0):
        raise ValueError(f"no binomial interval of {hits} in {trials} with confidence {confidence}")
    low, high = binomtest(hits, trials).proportion_ci(confidence, method="exact")
    return float(low), float(high)
