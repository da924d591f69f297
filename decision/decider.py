"""Whoever decides: the monitor in the robot's own process, a client or a fleet of them over HTTP."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from decision.decision import Decision, Decisions
from decision.memory import Memory


class Decider(Protocol):
    """Decides for one robot: a `Monitor`, a `Client`, a `Fleet`."""

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """Observation (O,), hazards (n, 2) in the body frame [m], the `memory` of its last decision."""


class BatchDecider(Decider, Protocol):
    """Decides for many robots at once as well: a `Monitor`, a `Fleet`."""

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        """Observation (N, O), hazards (N, n, 2) [m] with rows of NaN for none, memory (N,)."""
