"""The gate: when the filter is active."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from decision import OpenedBy, texts
from monitor.errors import MonitorError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GateName = Literal["risk", "always", "off"]
"""When the filter is active: where the risk score or the barrier asks for it, always, never."""
GATES: tuple[GateName, ...] = get_args(GateName)


@dataclass(frozen=True)
class Gate:
    """Opens early where the risk score is high, and at the latest where the barrier is low.

    Attributes:
        name: `risk` opens where risk > threshold, and where the barrier is so low that some action might lead
            below 0, whatever the risk says; `always` and `off` look at neither.
        threshold: finite and at least 0.

    Raises:
        MonitorError: for an unknown name or a threshold that is none.
    """

    name: GateName
    threshold: float

    def __post_init__(self) -> None:
        """Refuse what is no gate."""
        if self.name not in GATES:
            raise MonitorError(f"gate must be one of {', '.join(GATES)}, got {self.name!r}")
        if not (math.isfinite(self.threshold) and self.threshold >= 0.0):
            raise MonitorError(f"threshold must be finite and at least 0, got {self.threshold}")

    def opened_by(self, risk: FloatArray, low: BoolArray) -> NDArray[np.str_]:
        """What opens the gate for N robots: texts of `OpenedBy`, "" where it stays closed.

        Args:
            risk: (N,) the risk score; NaN opens the gate.
            low: (N,) whether the barrier is below its floor, see `filter.Scene.low`.
        """
        n = len(risk)
        if self.name != "risk":
            return texts(OpenedBy.ALWAYS if self.name == "always" else "", n)
        opened = np.where(low, texts(OpenedBy.BARRIER, n), texts("", n))
        return np.where(risk <= self.threshold, opened, texts(OpenedBy.RISK, n))
