"""Whether episodes still look like those that a gate was calibrated on: a conformal test martingale.

What a calibration promises holds as long as new episodes are exchangeable with its own. Each new episode gets
a conformal p-value, the rank of its score among all scores so far, those that the calibration kept included;
ties are broken at random. Under exchangeability these are independent and uniform, whatever the scores'
distribution. The martingale bets against that: wealth of several gamblers ε, who gain 1 + ε (p − 1/2) an
episode and share a hundredth of it among each other, so that whoever is right can start late (the Simple
Jumper; Vovk et al., *Retrain or not retrain: conformal test martingales for change-point detection*, 2021).
By Ville's inequality it ever reaches 1/δ with probability at most δ, however long and often one looks.

The score is what the promise is about: how silent λ was where it had to speak, the largest 1 / (1 + λ) over
those steps. In the closed loop they are those on which the barrier, by the lidar, is below its floor; without
a filter those in the lead time before each violation.

This module needs numpy alone: it runs on a robot as well.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pointgoal import seeds
from pointgoal.seeds import Use

FloatArray = NDArray[np.float64]

_BETS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
"""ε of the gamblers: all that stay solvent, for |ε| ≤ 2."""
_JUMP = 0.01
"""Share of its wealth that each gives to all in every episode."""
_MOST = 700.0
"""Logarithm of the largest value that is told."""


def silence(risk: ArrayLike, counts: ArrayLike) -> FloatArray:
    """How silent λ was in E episodes: the largest 1 / (1 + λ) over the steps that count, 0 where none does.

    Args:
        risk: λ [T, E], or of one episode [T].
        counts: whether λ had to speak there, likewise.

    Returns:
        [E], or one number, in [0, 1].
    """
    spoken = np.where(np.asarray(counts, np.bool_), 1.0 / (1.0 + np.asarray(risk, np.float64)), 0.0)
    return np.asarray(spoken.max(axis=0, initial=0.0))


class Exchangeability:
    """The test, one new episode after the other.

    Args:
        reference: scores of episodes of the calibration, at least one: the manifest's `calibration.scores`.
        doubt: δ, the largest probability of a false alarm.

    Attributes:
        episodes: how many new ones there were.
        value: of the martingale, 1 at first.
        largest: its value at its highest.
        alarmed: the number, from 1, of the episode in which it reached `bound`; None: it has not.
        bound: 1/δ.

    Raises:
        ValueError: for no reference, a score that is no number, or a δ that is not between 0 and 1.
    """

    def __init__(self, reference: Iterable[float], doubt: float = 0.05) -> None:
        self._scores = sorted(map(float, reference))
        if not self._scores or not np.isfinite(self._scores).all():
            raise ValueError(f"reference must be at least one finite number, got {self._scores[:3]}")
        if not 0.0 < doubt < 1.0:
            raise ValueError(f"doubt must be between 0 and 1, got {doubt}")
        self.bound = 1.0 / doubt
        self.episodes = 0
        self.value = self.largest = 1.0
        self.alarmed: int | None = None
        self._wealth = np.full(len(_BETS), 1.0 / len(_BETS))
        self._log_value = 0.0
        self._rng = seeds.generator(Use.EXCHANGE, 0)

    def add(self, score: float) -> float:
        """Takes a new episode's score into account, and returns the martingale's value.

        Raises:
            ValueError: if it is not finite.
        """
        if not np.isfinite(score):
            raise ValueError(f"score must be finite, got {score}")
        self._bet(self._p_value(float(score)))
        self.episodes += 1
        self.largest = max(self.largest, self.value)
        if self.alarmed is None and self.value >= self.bound:
            self.alarmed = self.episodes
        return self.value

    def _p_value(self, score: float) -> float:
        """Share of larger scores, the new one among them, with equal ones in random order."""
        below, upto, count = (
            bisect_left(self._scores, score),
            bisect_right(self._scores, score),
            len(self._scores),
        )
        insort(self._scores, score)
        return float((count - upto + self._rng.random() * (upto - below + 1)) / (count + 1))

    def _bet(self, p: float) -> None:
        shared = (1.0 - _JUMP) * self._wealth + _JUMP * self._wealth.mean()
        grown = shared * (1.0 + _BETS * (p - 0.5))
        # Shares and a logarithm: no number holds what a thousand episodes of a broken robot come to.
        self._wealth = grown / grown.sum()
        self._log_value += float(np.log(grown.sum()))
        self.value = float(np.exp(min(self._log_value, _MOST)))


def fewest_episodes(doubt: float) -> int:
    """After how many episodes there can be an alarm at the earliest: with p = 0 in all of them."""
    test = Exchangeability([0.0], doubt)
    while test.value < test.bound:
        test._bet(0.0)
        test.episodes += 1
    return test.episodes
