"""A decider that a test scripts, and a monitor of the tiny bundle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.closed_loop import Episodes, run_episodes
from evaluation.deciders import Decided, InProcess
from filter import Mode
from monitor import Monitor


class Scripted:
    """Sends one and the same action, and calls every fifth decision filtered and every tenth a fallback."""

    def __init__(self, action: tuple[float, float]) -> None:
        self.action = action
        self.calls = 0

    def start(self, count: int) -> None:
        self.calls = 0

    def decide(self, observation, hazards) -> Decided:
        count = len(observation)
        self.calls += 1
        mode = (
            Mode.FALLBACK if self.calls % 10 == 0 else Mode.FILTERED if self.calls % 5 == 0 else Mode.NOMINAL
        )
        return Decided(
            action=np.tile(np.array(self.action), (count, 1)),
            risk=np.full(count, self.calls / 1000.0),
            mode=np.full(count, mode, np.int8),
            barrier=np.full(count, 0.5),
            reason=["because" if mode == Mode.FALLBACK else None] * count,
        )

    def seconds(self, observation, hazards) -> list[float]:
        return [0.001] * len(observation)


@pytest.fixture(scope="session")
def full_thrust() -> Episodes:
    """Three recorded episodes of a robot that turns under full thrust."""
    return run_episodes("PointGoal1-v0", Scripted((1.0, 0.25)), 3, seed=7, record=True)


@pytest.fixture(scope="session")
def always(tiny_bundle: Path) -> InProcess:
    """The tiny bundle with its filter always active, in process."""
    return InProcess(Monitor.load(tiny_bundle, "always"))
