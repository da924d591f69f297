"""A large batch is decided in parts side by side: what computes lets go of the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from decision.decision import Decisions
from decision.memory import Memory

FloatArray = NDArray[np.float64]

LEAST = 200
"""Robots of the smallest part: fewer are decided about sooner than threads are started."""


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parts(
    decide: Callable[[FloatArray, FloatArray | None, Memory], Decisions],
    observation: FloatArray,
    hazards: FloatArray | None,
    memory: Memory,
) -> Decisions:
    """Decide about many robots, on as many cores as there are.

    Args:
        decide: decides about some of them; several threads may call it.
        observation: (N, O), and
        hazards: (N, n, 2) or None, and
        memory: (N,), which ``decide`` gets some rows of.

    Returns:
        The decisions about all of them, in order.
    """
    count = len(observation)
    parts = min(cores(), count // LEAST)
    if parts < 2:
        return decide(observation, hazards, memory)

    def part(some: slice) -> Decisions:
        return decide(observation[some], None if hazards is None else hazards[some], memory[some])

    bounds = np.linspace(0, count, parts + 1).astype(int).tolist()
    # Threads that are kept would not outlive a fork; starting them takes a tenth of a microsecond a robot.
    with ThreadPoolExecutor(parts, "decisions") as threads:
        return Decisions.join(list(threads.map(part, map(slice, bounds[:-1], bounds[1:]))))
