"""How old an observation is, by the clock of the robot that stamped it."""

from __future__ import annotations

import math

DRIFT = 5e-4
"""How much faster or slower than ours a clock may run: what NTP slews one by at most."""
LEARNING = 1.0
"""For how long the first delays are compared with each other alone [s]."""
LEARNING_STAMPS = 10
"""How many stamps that takes at least."""
_LONGEST_GAP = 60.0
"""A silence says no more about the clock's drift than one of this length [s]."""


class ClockError(ValueError):
    """A stamp that tells nothing, because the clock that made it cannot be trusted."""


class Clock:
    """What is learned of one robot's clock.

    Its epoch is its own. The smallest of (ours - stamp) so far belongs to the observation that came the
    quickest; another is older by what its own is above that. The clock may drift, so the smallest is let
    rise, but by no more than `DRIFT`: a network that becomes slow is not taken for a clock that is.

    What cannot be told from a slow clock is a delay that grows by less than that; and how late the quickest
    itself was.

    Args:
        jump: by how much the smallest may fall at once, learning over, before the clock counts as one that
            runs ahead [s]. An observation may be older by that than it seems.
    """

    def __init__(self, jump: float) -> None:
        self._jump = jump
        self._began = self._at = math.nan
        self._stamps = 0
        self._last = self._least = self._settled = math.nan

    def age(self, stamp: float, now: float) -> float:
        """How old an observation is [s].

        Args:
            stamp: when it was made, by the robot's clock [s].
            now: when it came, by ours [s].

        Raises:
            ClockError: if the stamp is before an earlier one, or the clock runs ahead of what was learned.
                Nothing is learned from such a stamp.
        """
        offset = now - stamp
        if self._stamps == 0:
            self._began = self._at = now
            self._last, self._least, self._settled = stamp, offset, offset
        if stamp < self._last:
            raise ClockError(f"the stamp goes back by {self._last - stamp:.6g} s")
        drift = DRIFT * min(max(now - self._at, 0.0), _LONGEST_GAP)
        learning = now - self._began < LEARNING or self._stamps < LEARNING_STAMPS
        ahead = self._settled - offset
        if not learning and ahead > self._jump + drift:
            raise ClockError(f"the robot's clock runs {ahead:.6g} s ahead of what was learned of it")
        self._stamps += 1
        self._at, self._last = now, stamp
        self._least = min(self._least + drift, offset)
        # Follows no faster than a clock may drift: many small jumps are one large one.
        pull = math.inf if learning else drift
        self._settled += min(max(self._least - self._settled, -pull), pull)
        return offset - self._least
