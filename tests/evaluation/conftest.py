"""What decides as a test says, and a monitor of the tiny bundle."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from decision import Decision, Decisions, Mode, OpenedBy, Origin
from evaluation.closed_loop import Episodes, run_episodes
from monitor import Monitor


class Scripted:
    """Sends one and the same action, and says of it what a robot's step in its episode makes it say.

    The step is counted in the memory that it gives back, so a loop that mixes up its robots' memories shows.
    """

    def __init__(self, action: tuple[float, float] = (1.0, 0.25), says=None) -> None:
        self.action = action
        self.says = says or usually
        self.singles = 0

    def decide(self, observation, hazards=None, memory=None) -> Decision:
        self.singles += 1
        assert observation.ndim == 1
        assert hazards is None or hazards.shape[1:] == (2,)
        return self._rows(np.asarray(memory).reshape(1))[0]

    def decide_batch(self, observation, hazards=None, memory=None) -> Decisions:
        assert len(observation) == len(memory)
        return self._rows(memory)

    def _rows(self, memory) -> Decisions:
        count = len(memory)
        after = memory.copy()
        after["plan"][:, 0, 0] += 1.0
        told = [self.says(int(step)) for step in after["plan"][:, 0, 0]]
        mode, origin, opened_by, certified = zip(*told, strict=True)
        return Decisions(
            action=np.tile(np.array(self.action), (count, 1)),
            nominal_action=np.tile(np.array(self.action), (count, 1)),
            mode=np.array(mode, dtype="<U8"),
            origin=np.array(origin, dtype="<U11"),
            certified=np.array(certified),
            barrier=np.full(count, 0.5),
            hazard=np.full(count, -1),
            reason=["because" if kind == Mode.FALLBACK else None for kind in mode],
            risk=after["plan"][:, 0, 0] / 1000.0,
            threshold=0.5,
            opened_by=np.array(opened_by, dtype="<U7"),
            novelty=np.zeros(len(opened_by)),
            suspect=np.full(len(opened_by), ""),
            memory=after,
        )


def usually(step: int):
    """Every tenth step a fallback, every fifth filtered, every other third guided though certified."""
    if step % 10 == 0:
        return Mode.FALLBACK, Origin.PLAN, OpenedBy.RISK, False
    if step % 5 == 0:
        return Mode.FILTERED, Origin.BARRIER, OpenedBy.BARRIER, False
    if step % 3 == 0:
        return Mode.GUIDED, Origin.GUIDE, OpenedBy.RISK, True
    return (Mode.NOMINAL, "", OpenedBy.RISK, True) if step % 2 else (Mode.NOMINAL, "", "", False)


class Dying(Scripted):
    """A fleet whose service has, from a step on, so many robots' faults of some kind."""

    def __init__(self, kind: str, after: int, robots: int) -> None:
        super().__init__()
        self.faults = SimpleNamespace(counts=Counter())
        self.kind, self.after, self.robots, self.steps = kind, after, robots, 0

    def decide_batch(self, observation, hazards=None, memory=None) -> Decisions:
        decisions = super().decide_batch(observation, hazards, memory)
        self.steps += 1
        if self.steps > self.after:
            self.faults.counts[self.kind] += self.robots
            for i in range(self.robots):
                decisions.mode[i], decisions.origin[i] = Mode.FALLBACK, Origin.PLAN
                decisions.opened_by[i], decisions.reason[i] = OpenedBy.FAULT, f"{self.kind}: refused"
        return decisions


@pytest.fixture(scope="session")
def scripted() -> type[Scripted]:
    """Makes what decides as a test says."""
    return Scripted


@pytest.fixture(scope="session")
def dying() -> type[Dying]:
    """Makes a fleet whose service fails."""
    return Dying


@pytest.fixture(scope="session")
def full_thrust() -> Episodes:
    """Three recorded episodes of a robot that turns under full thrust."""
    return run_episodes("PointGoal1-v0", Scripted(), 3, seed=7, record=True)


@pytest.fixture(scope="session")
def always(tiny_bundle: Path) -> Monitor:
    """The tiny bundle with its filter always active, in process."""
    return Monitor.load(tiny_bundle, "always")
