"""Who decides at the moment, and how another takes over: a new bundle, or the hold."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from decision import Decision, Decisions, Memory, memory_of
from monitor import Monitor
from server.schema import ModelReply

UNDECIDED = "not decided: "
"""What the reason begins with where the monitor was not asked, or did not answer in time."""
SAME = ("observation_layout", "action_low", "action_high", "hazard_radius", "robot")
"""What must not change when another bundle takes over: robots send the one, and their certified plans, which
their memories hold, hang on the others."""
HELD = "hold"
"""How the reasons of held decisions go on."""


class OnDuty(NamedTuple):
    """Who decides, and whose word it is. A decision that has begun keeps the one it began with."""

    monitor: Monitor
    model: ModelReply
    """What it tells of itself."""
    decider: Monitor | Held
    """The monitor, or who sends the safe action in its place."""
    robot: str
    """A hash of `SAME`."""

    @classmethod
    def of(cls, monitor: Monitor, model: ModelReply | None = None) -> Self:
        """A monitor that decides, and what it tells of itself, if that is known already."""
        told = model or ModelReply.of(monitor)
        same = told.model_dump_json(include=set(SAME))
        return cls(monitor, told, monitor, hashlib.sha256(same.encode()).hexdigest())


class Held:
    """Decides for nobody: each robot's plan goes on, then it coasts.

    Args:
        monitor: in whose place.
        why: why, in words.
    """

    def __init__(self, monitor: Monitor, why: str) -> None:
        self._monitor = monitor
        self._reason = f"{UNDECIDED}{HELD}: {why}"

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """The safe decision for one robot, whatever it sees."""
        return self._hold(memory_of(1, memory))[0]

    def decide_lost(
        self, observation: ArrayLike, hazards: ArrayLike | None, memory: Any, lost: str
    ) -> Decision:
        """The safe decision for a robot whose memory is ``lost``."""
        return self.decide(observation, hazards, memory)

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        """The safe decisions for N robots (N, O)."""
        return self._hold(memory_of(len(np.asarray(observation)), memory))

    def _hold(self, memory: Memory) -> Decisions:
        return self._monitor.fall_back(memory, self._reason)


class Duty:
    """Who decides at the moment.

    Args:
        monitor: the first.
        model: what it tells of itself, if that is known already.

    Attributes:
        now: read once a decision.
    """

    def __init__(self, monitor: Monitor, model: ModelReply | None = None) -> None:
        self.now = OnDuty.of(monitor, model)

    def take_over(self, monitor: Monitor, why_held: str | None) -> None:
        """Another monitor decides from now on, unless every decision is held; its faults are counted on."""
        monitor.faults = self.now.monitor.faults
        self.now = OnDuty.of(monitor)
        self.hold(why_held)

    def hold(self, why: str | None) -> None:
        """From now on every decision is the safe one, for this reason; None: the monitor decides again."""
        monitor = self.now.monitor
        self.now = self.now._replace(decider=monitor if why is None else Held(monitor, why))
