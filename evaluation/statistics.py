"""What a set of episodes says: means, counts, and how sure the rate of violating episodes is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from evaluation.closed_loop import Episodes, IntArray

CONFIDENCE = 0.95
"""Confidence of the interval of the rate of violating episodes."""


@dataclass(frozen=True)
class Summary:
    """The figures of a set of episodes.

    Attributes:
        episodes: how many.
        steps: steps in all episodes.
        return_mean: mean return.
        return_std: standard deviation of the return.
        return_p10: the return that 90 % of the episodes exceed.
        cost_mean: mean depth cost of an episode, metres inside hazards summed over steps.
        indicator_cost_mean: mean indicator cost of an episode: its violating steps.
        violating_steps: steps with a cost above 0, in all episodes.
        violating_episodes: episodes with at least one.
        violation_rate: their share.
        violation_low: lower end of its exact 95 % interval.
        violation_high: upper end.
        open_steps: steps with the gate open.
        opened_by: cause → those of them that it opened; the barrier's are its alone.
        interventions: steps on which the action sent was not the nominal one.
        origins: origin → those of them that it gave the action of.
        certified_replaced: those of them whose nominal action had a certificate.
        modes: mode → steps in it.
        decision_p50: median of the decision time [s].
        decision_p99: 99th percentile of the decision time [s].
        reasons: reason → fallbacks that gave it; the ten most frequent.
    """

    episodes: int
    steps: int
    return_mean: float
    return_std: float
    return_p10: float
    cost_mean: float
    indicator_cost_mean: float
    violating_steps: int
    violating_episodes: int
    violation_rate: float
    violation_low: float
    violation_high: float
    open_steps: int
    opened_by: dict[str, int]
    interventions: int
    origins: dict[str, int]
    certified_replaced: int
    modes: dict[str, int]
    decision_p50: float
    decision_p99: float
    reasons: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """The figures as plain JSON, and beside the counts of steps their shares of all steps."""
        shares = {
            "open": self.open_steps / self.steps,
            "opened_by": {cause: count / self.steps for cause, count in self.opened_by.items()},
            "interventions": self.interventions / self.steps,
            "origins": {origin: count / self.steps for origin, count in self.origins.items()},
            "certified_replaced": self.certified_replaced / self.steps,
        }
        return asdict(self) | {"shares": shares}


def summarise(episodes: Episodes) -> Summary:
    """The figures of a set of episodes."""
    violating = int((episodes.violating_steps > 0).sum())
    count = len(episodes.returns)
    low, high = clopper_pearson(violating, count)
    p50, p99 = np.percentile(episodes.seconds, [50, 99])
    return Summary(
        episodes=count,
        steps=int(episodes.steps.sum()),
        return_mean=float(episodes.returns.mean()),
        return_std=float(episodes.returns.std()),
        return_p10=float(np.percentile(episodes.returns, 10)),
        cost_mean=float(episodes.costs.mean()),
        indicator_cost_mean=float(episodes.violating_steps.mean()),
        violating_steps=int(episodes.violating_steps.sum()),
        violating_episodes=violating,
        violation_rate=violating / count,
        violation_low=low,
        violation_high=high,
        open_steps=int(episodes.open_steps.sum()),
        opened_by=_totals(episodes.opened_by),
        interventions=int(episodes.interventions.sum()),
        origins=_totals(episodes.origins),
        certified_replaced=int(episodes.certified_replaced.sum()),
        modes=_totals(episodes.modes),
        decision_p50=float(p50),
        decision_p99=float(p99),
        reasons=dict(Counter(episodes.reasons).most_common(10)),
    )


def _totals(counts: Mapping[Any, IntArray]) -> dict[str, int]:
    return {str(name): int(count.sum()) for name, count in counts.items()}


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
