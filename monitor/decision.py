"""What a monitor answers: the action to send, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from filter import FilterMemory, Mode
from monitor.memory import take

FloatArray = NDArray[np.float64]
ModeName = Literal["nominal", "filtered", "fallback"]

_NAMES: dict[int, ModeName] = {Mode.NOMINAL: "nominal", Mode.FILTERED: "filtered", Mode.FALLBACK: "fallback"}


@dataclass(frozen=True)
class Decision:
    """One robot's decision for one observation.

    Attributes:
        action: [2], what to send to the robot.
        nominal_action: [2], the policy's; NaN where the policy gave no number.
        risk: the risk score λ_ξ(s); NaN where the multiplier network gave no number.
        threshold: the gate `risk` activates the filter where risk is above this.
        mode: "nominal" only if `action` is `nominal_action` bit for bit; "filtered" if the filter changed it;
            "fallback" if a backup manoeuvre or, on a fault, the safe action is sent.
        barrier: h [m], ≥ 0 is safe, at most the lidar's range; NaN if it could not be computed.
        hazard: index of the hazard that caused the intervention, or None.
        row: label of the QP's row that caused it, or None.
        reason: why the mode is "fallback", or None.
        gate_open: whether the filter was active.
        memory: what to pass to the next call for this robot; empty after a fault.
    """

    action: FloatArray
    nominal_action: FloatArray
    risk: float
    threshold: float
    mode: ModeName
    barrier: float
    hazard: int | None
    row: str | None
    reason: str | None
    gate_open: bool
    memory: FilterMemory | None


@dataclass(frozen=True)
class DecisionBatch:
    """N robots' decisions; the fields are those of `Decision` with a leading axis [N].

    Attributes:
        action: [N, 2].
        nominal_action: [N, 2].
        risk: [N].
        threshold: one for all.
        mode: [N], of `filter.Mode`.
        barrier: [N] in [m].
        hazard: [N], −1 for none.
        row: N labels or None.
        reason: N reasons or None.
        gate_open: [N].
        memory: of all N robots.
    """

    action: FloatArray
    nominal_action: FloatArray
    risk: FloatArray
    threshold: float
    mode: NDArray[np.int8]
    barrier: FloatArray
    hazard: NDArray[np.int64]
    row: list[str | None]
    reason: list[str | None]
    gate_open: NDArray[np.bool_]
    memory: FilterMemory | None

    def __len__(self) -> int:
        return len(self.mode)

    def __getitem__(self, index: int) -> Decision:
        """The decision of one robot."""
        return Decision(
            action=self.action[index],
            nominal_action=self.nominal_action[index],
            risk=float(self.risk[index]),
            threshold=self.threshold,
            mode=_NAMES[int(self.mode[index])],
            barrier=float(self.barrier[index]),
            hazard=int(self.hazard[index]) if self.hazard[index] >= 0 else None,
            row=self.row[index],
            reason=self.reason[index],
            gate_open=bool(self.gate_open[index]),
            memory=None if self.memory is None else take(self.memory, index),
        )
