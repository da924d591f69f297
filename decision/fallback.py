"""The fallback of whoever cannot decide: the certified plan goes on, then the robot coasts."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from decision.decision import SAFE_ACTION, Decisions, Mode, OpenedBy, Origin
from decision.memory import Memory, next_of_plan, remember_sent


def fall_back(
    memory: Memory, reason: str, threshold: float = np.nan, safe: ArrayLike = SAFE_ACTION
) -> Decisions:
    """Decides for N robots about which nothing else is known.

    Args:
        memory: (N,) of `MEMORY`: what their last decisions left.
        reason: what failed.
        threshold: the gate's.
        safe: (2,) what to send once a plan has ended.

    Returns:
        Their plans' next actions, and the memory without them.
    """
    count = len(memory)
    action, after = next_of_plan(memory)
    action = np.where((memory["left"] > 0)[:, None], action, np.asarray(safe, np.float64))
    remember_sent(after, action)
    return Decisions(
        action=action,
        nominal_action=np.full((count, 2), np.nan),
        mode=np.full(count, Mode.FALLBACK),
        origin=np.full(count, Origin.PLAN),
        certified=np.zeros(count, np.bool_),
        barrier=np.full(count, np.nan),
        hazard=np.full(count, -1),
        reason=[reason] * count,
        risk=np.full(count, np.nan),
        threshold=threshold,
        opened_by=np.full(count, OpenedBy.FAULT),
        novelty=np.full(count, np.nan),
        suspect=np.full(count, ""),
        memory=after,
    )
