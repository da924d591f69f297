"""The gate: when the filter is active."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from decision import MOST_OPEN, Memory, OpenedBy, texts
from monitor.errors import MonitorError
from system.compiled import entry

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GateName = Literal["risk", "always", "off"]
"""When the filter is active: where the risk score or the barrier asks for it, always, never."""
GATES: tuple[GateName, ...] = get_args(GateName)
_ALWAYS = OpenedBy.ALWAYS.value
_CAUSES = np.concatenate([texts(cause, 1) for cause in ("", OpenedBy.BARRIER, OpenedBy.DWELL, OpenedBy.RISK)])
"""Each one overrides those before it."""


@dataclass(frozen=True)
class Gate:
    """Opens early where the risk score is high, and at the latest where the barrier is low; closes late.

    Attributes:
        name: `risk` opens where risk > threshold, and where the barrier is so low that some action might lead
            below 0, whatever the risk says; `always` and `off` look at neither.
        threshold: finite and at least 0.
        hysteresis: in (0, 1]. An open gate `risk` stays open while risk > hysteresis · threshold, while the
            barrier is low, and while the filter sends another action than the policy's.
        dwell: for how many control steps after that it still stays open, in a robot's memory.
        floor: whether a low barrier opens it; without, nothing is certified where λ is silent: to measure λ.

    Raises:
        MonitorError: for an unknown name, or a number that is out of its range.
    """

    name: GateName
    threshold: float
    hysteresis: float = 1.0
    dwell: int = 0
    floor: bool = True

    def __post_init__(self) -> None:
        """Refuse what is no gate."""
        if self.name not in GATES:
            raise MonitorError(f"gate must be one of {', '.join(GATES)}, got {self.name!r}")
        if not (math.isfinite(self.threshold) and self.threshold >= 0.0):
            raise MonitorError(f"threshold must be finite and at least 0, got {self.threshold}")
        if not 0.0 < self.hysteresis <= 1.0:
            raise MonitorError(f"hysteresis must be above 0 and at most 1, got {self.hysteresis}")
        if not 0 <= self.dwell <= MOST_OPEN:
            raise MonitorError(f"dwell must be 0 to {MOST_OPEN} control steps, got {self.dwell}")

    def opened_by(self, risk: FloatArray, low: BoolArray, memory: Memory) -> NDArray[np.str_]:
        """What opens the gate for N robots: texts of `OpenedBy`, "" where it stays closed.

        Args:
            risk: (N,) the risk score; NaN opens the gate.
            low: (N,) whether the barrier is below its floor, see `filter.Scene.low`.
            memory: (N,) of `MEMORY`.
        """
        if self.name != "risk":
            return texts(_ALWAYS if self.name == "always" else "", len(risk))
        low = low if self.floor else low & False
        return _CAUSES[_causes(risk, low, memory, self.threshold)]

    def remember(self, risk: FloatArray, low: BoolArray, changed: BoolArray, memory: Memory) -> None:
        """Write into N robots' memory how long their gates stay open; arguments as for `opened_by`.

        ``changed`` (N,): whether the filter sends another action than the policy's.
        """
        if self.name == "risk" and self.dwell:
            low = low if self.floor else low & False
            _stay(risk, low, changed, memory, self.threshold, self.threshold * self.hysteresis, self.dwell)


@entry
def _causes(risk: FloatArray, low: BoolArray, memory: Memory, opens: float) -> NDArray[np.int64]:
    """Places in `_CAUSES` of what opens N gates."""
    if not len(risk) == len(low) == len(memory):
        raise ValueError("risk, low and memory must be of the same robots")
    causes = np.zeros(len(risk), np.int64)
    for k in range(len(risk)):
        causes[k] = 3 if not risk[k] <= opens else 2 if memory[k].open > 0 else 1 if low[k] else 0
    return causes


@entry
def _stay(
    risk: FloatArray, low: BoolArray, changed: BoolArray, memory: Memory, opens: float, keeps: float, n: int
) -> None:
    """Write into N robots' memory how many more steps gates stay open, n at most, see `Gate.remember`."""
    if not len(risk) == len(low) == len(changed) == len(memory):
        raise ValueError("risk, low, changed and memory must be of the same robots")
    for k in range(len(risk)):
        left = memory[k].open
        opened = left > 0 or not risk[k] <= opens or low[k]
        engaged = not risk[k] <= keeps or low[k] or changed[k]
        memory[k].open = n if opened and engaged else max(left - 1, 0)
