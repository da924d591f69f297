"""A decision, for many robots at once and for one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from decision.memory import Memory

FloatArray = NDArray[np.float64]
TextArray = NDArray[np.str_]


@lru_cache(maxsize=64)
def texts(text: str, n: int) -> TextArray:
    """The same text n times, not to be written to; wide enough for whatever stands in `Decisions`."""
    made = np.full(n, text, dtype="<U13")
    made.setflags(write=False)
    return made


SAFE_ACTION = (0.0, 0.0)
"""Zero thrust, no turn: what to send when nothing is known."""


@lru_cache(maxsize=64)
def unknown(n: int) -> FloatArray:
    """NaN n times; not to be written to."""
    made = np.full(n, np.nan)
    made.setflags(write=False)
    return made


class Mode(StrEnum):
    """What became of the nominal action."""

    NOMINAL = "nominal"
    """It was sent, bit for bit."""
    GUIDED = "guided"
    """The guide's action was sent in its place, as the guide proposed it."""
    FILTERED = "filtered"
    """The filter sent another action, which is certified."""
    FALLBACK = "fallback"
    """Nothing could be certified, or something failed: the plan goes on, or the least harm is done."""


class Origin(StrEnum):
    """What an action that is not the nominal one comes from."""

    BARRIER = "barrier"
    """The QP, by its barrier rows alone."""
    CIRCULATION = "circulation"
    """The QP, whose circulation row turned the robot along the obstacle."""
    SEARCH = "search"
    """The search: no QP had a certified solution, another action near by was certified."""
    PLAN = "plan"
    """What is left of the certified backup, or a backup that keeps the inner margin."""
    HARM = "least harm"
    """The manoeuvre that does the least harm: a robot inside a hazard, or too fast to stay out of it."""
    GUIDE = "guide"
    """The guide, which leads the robot round what is in its way."""


class OpenedBy(StrEnum):
    """Why the filter was active."""

    ALWAYS = "always"
    """The gate is always open."""
    RISK = "risk"
    """The risk score is above the threshold, or is no number."""
    BARRIER = "barrier"
    """The barrier is below the floor, and the risk score is not above the threshold."""
    NOVELTY = "novelty"
    """A sensor shows what it should not, whatever the risk score says."""
    DWELL = "dwell"
    """It was open and stays so: the risk score has not been low for long enough, or the filter has the robot
    in hand. Where the score is above the threshold that is the cause."""
    FAULT = "fault"
    """Something failed."""


_MODES = {mode.value: mode for mode in Mode}
_ORIGINS = {"": None} | {origin.value: origin for origin in Origin}
_OPENED_BY = {"": None} | {cause.value: cause for cause in OpenedBy}


@dataclass(frozen=True)
class Decision:
    """One robot's decision for one observation: a row of `Decisions`.

    Attributes:
        action: (2,) what to send to the robot.
        nominal_action: (2,) the policy's; NaN where the policy gave no number.
        mode: what became of the nominal action; "nominal" only if `action` is it bit for bit.
        origin: what the action comes from if it is not the nominal one, else None.
        certified: whether the nominal action had a certificate; False where none was asked for.
        barrier: clearance [m] beyond the margin that the best backup keeps; >= 0 is safe, at most the lidar's
            range; NaN if it could not be computed.
        hazard: index of the hazard (given hazards first, then lidar bins) behind an intervention, or None.
        reason: why the mode is "fallback", or None.
        risk: the risk score λ_ξ(s); NaN where the multiplier network gave no number or there is none.
        threshold: the gate `risk` opens where the risk score is above this; NaN without a gate.
        opened_by: why the filter was active; None where the gate was closed.
        novelty: how far the observation is from what it should be, in parts of what is still let pass: above
            1 the gate opens, whatever the risk score says; NaN if nobody looked.
        suspect: the sensor that is the farthest from it, where the novelty is above 1, else None.
        memory: what to pass to the next call for this robot, one of `MEMORY`.
    """

    action: FloatArray
    nominal_action: FloatArray
    mode: Mode
    origin: Origin | None
    certified: bool
    barrier: float
    hazard: int | None
    reason: str | None
    risk: float
    threshold: float
    opened_by: OpenedBy | None
    novelty: float
    suspect: str | None
    memory: np.void

    @property
    def gate_open(self) -> bool:
        """Whether the filter was active."""
        return self.opened_by is not None

    @property
    def plan(self) -> FloatArray:
        """(k, 2) the actions that are safe to send next if nothing else can be decided; then coast."""
        return np.asarray(self.memory["plan"][: self.memory["left"]])


@dataclass(eq=False, slots=True)
class Decisions:
    """N robots' decisions; the fields are those of `Decision` with a leading axis (N,).

    Attributes:
        action: (N, 2).
        nominal_action: (N, 2).
        mode: (N,) texts of `Mode`.
        origin: (N,) texts of `Origin`; "" for none.
        certified: (N,).
        barrier: (N,) [m].
        hazard: (N,), -1 for none.
        reason: N texts or None.
        risk: (N,).
        threshold: one for all.
        opened_by: (N,) texts of `OpenedBy`; "" where the gate was closed.
        novelty: (N,).
        suspect: (N,) the sensors' names; "" for none.
        memory: (N,) of `MEMORY`.
    """

    action: FloatArray
    nominal_action: FloatArray
    mode: TextArray
    origin: TextArray
    certified: NDArray[np.bool_]
    barrier: FloatArray
    hazard: NDArray[np.int64]
    reason: list[str | None]
    risk: FloatArray
    threshold: float
    opened_by: TextArray
    novelty: FloatArray
    suspect: TextArray
    memory: Memory

    def __len__(self) -> int:
        return len(self.mode)

    def __getitem__(self, index: int) -> Decision:
        """The decision of one robot."""
        hazard = self.hazard.item(index)
        row = Decision.__new__(Decision)
        # A frozen class sets its fields one by one, which takes a tenth of what both networks take.
        row.__dict__.update(
            action=self.action[index],
            nominal_action=self.nominal_action[index],
            mode=_MODES[self.mode.item(index)],
            origin=_ORIGINS[self.origin.item(index)],
            certified=self.certified.item(index),
            barrier=self.barrier.item(index),
            hazard=hazard if hazard >= 0 else None,
            reason=self.reason[index],
            risk=self.risk.item(index),
            threshold=self.threshold,
            opened_by=_OPENED_BY[self.opened_by.item(index)],
            novelty=self.novelty.item(index),
            suspect=self.suspect.item(index) or None,
            memory=self.memory[index],
        )
        return row

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(N,) whether another action than the nominal one is sent."""
        n = len(self.mode)
        nominal = texts(Mode.NOMINAL, n)
        # numpy takes its time to compare texts, and mostly there is nothing to compare.
        return np.zeros(n, np.bool_) if self.mode is nominal else np.asarray(self.mode != nominal)

    def told(
        self,
        nominal_action: FloatArray,
        risk: FloatArray,
        threshold: float,
        opened_by: TextArray,
        novelty: FloatArray,
        suspect: TextArray,
    ) -> Decisions:
        """These decisions, with what the policy asked for, what the gate says, and what is novel."""
        return Decisions(
            self.action,
            nominal_action,
            self.mode,
            self.origin,
            self.certified,
            self.barrier,
            self.hazard,
            self.reason,
            risk,
            threshold,
            opened_by,
            novelty,
            suspect,
            self.memory,
        )

    @property
    def gate_open(self) -> NDArray[np.bool_]:
        """(N,) whether the filter was active."""
        return np.asarray(self.opened_by != "")

    def check(self, asked: FloatArray, active: NDArray[np.bool_], low: FloatArray, high: FloatArray) -> None:
        """Trust no filter: what it answers must be actions, and its modes must be true.

        Args:
            asked: (N, 2) the actions that it was to look at.
            active: (N,) where it may change them.
            low: (2,) the actions' lower bounds.
            high: (2,) their upper bounds.

        Raises:
            ValueError: saying what is wrong.
        """
        action, mode = self.action, self.mode
        if action.shape != asked.shape or mode.shape != active.shape:
            raise ValueError(f"the filter gave action {action.shape} and mode {mode.shape}")
        # Counting is how numpy looks through a few numbers soonest.
        if np.count_nonzero((action >= low) & (action <= high)) != action.size:
            raise ValueError(f"the filter gave an action outside of its bounds: {action.tolist()}")
        differs = action.view(np.int64) != asked.view(np.int64)
        changed = differs[:, 0] | differs[:, 1]
        if np.count_nonzero(changed & (mode == texts(Mode.NOMINAL, len(mode)))):
            raise ValueError("the filter changed an action and called it nominal")
        if np.count_nonzero(changed > active):
            raise ValueError("the filter changed an action though its gate is closed")

    @staticmethod
    def join(parts: Sequence[Decisions]) -> Decisions:
        """The decisions of several groups of robots as one, in order."""
        if len(parts) == 1:
            return parts[0]
        joined = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Decisions)
            if field.name not in ("reason", "threshold")
        }
        reason = [reason for part in parts for reason in part.reason]
        return Decisions(**joined, reason=reason, threshold=parts[0].threshold)

    @staticmethod
    def of(rows: Sequence[Decision]) -> Decisions:
        """The decisions of robots that were decided about one by one."""
        return Decisions(
            action=np.array([row.action for row in rows]),
            nominal_action=np.array([row.nominal_action for row in rows]),
            mode=np.array([row.mode for row in rows], dtype=np.str_),
            origin=np.array([row.origin or "" for row in rows], dtype=np.str_),
            certified=np.array([row.certified for row in rows]),
            barrier=np.array([row.barrier for row in rows]),
            hazard=np.array([-1 if row.hazard is None else row.hazard for row in rows]),
            reason=[row.reason for row in rows],
            risk=np.array([row.risk for row in rows]),
            threshold=rows[0].threshold,
            opened_by=np.array([row.opened_by or "" for row in rows], dtype=np.str_),
            novelty=np.array([row.novelty for row in rows]),
            suspect=np.array([row.suspect or "" for row in rows], dtype=np.str_),
            memory=np.array([row.memory for row in rows]),
        )
