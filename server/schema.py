"""What goes over the wire. No field of a reply can hold NaN or Inf: what is unknown is null."""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from models import Bundle, ObservationBlock
from monitor import SAFE_ACTION, Decision, Gate, ModeName, Monitor, memory_to_json

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""A JSON number; not a string, not a bool, not NaN or Inf in any spelling."""
Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]
MemoryJson = dict[str, list[Finite]]
MAX_HAZARDS = 1000
"""Most hazards a request may name."""


class ActRequest(BaseModel):
    """The body of `POST /act`.

    Attributes:
        observation: the numbers of the bundle's observation layout, in its order.
        hazards: centres of the hazards in the body frame [m], x ahead, y left; left out, the lidar is
            decoded.
        memory: the `memory` of this robot's last reply, unchanged; it may be left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    observation: Annotated[list[Finite], Field(min_length=1)]
    hazards: Annotated[list[Pair], Field(max_length=MAX_HAZARDS)] | None = None
    memory: MemoryJson | None = None


class ActReply(BaseModel):
    """The reply of `POST /act`.

    Attributes:
        action: what to send to the robot.
        nominal_action: the policy's action; null if it gave no number.
        risk: the risk score λ_ξ(s); null if the multiplier network gave no number.
        threshold: the gate `risk` activates the filter where risk is above this.
        mode: nominal, filtered or fallback.
        barrier: h [m], ≥ 0 is safe, at most the lidar's range; null if it could not be computed.
        hazard: index of the hazard that caused the intervention.
        row: label of the QP's row that caused it.
        reason: why the mode is fallback.
        gate_open: whether the filter was active.
        model: the bundle's id; null in a reply that the client made itself.
        seconds: how long the decision took [s].
        memory: to be sent back with this robot's next observation, if it likes.
    """

    model_config = ConfigDict(frozen=True)

    action: Pair
    nominal_action: Pair | None
    risk: Finite | None
    threshold: Finite | None
    mode: ModeName
    barrier: Finite | None
    hazard: int | None
    row: str | None
    reason: str | None
    gate_open: bool
    model: str | None
    seconds: Finite
    memory: MemoryJson | None

    @classmethod
    def of(cls, decision: Decision, model: str, seconds: float) -> Self:
        """The reply that tells a decision."""
        return cls(
            action=decision.action.tolist(),
            nominal_action=_finite_pair(decision.nominal_action),
            risk=_finite(decision.risk),
            threshold=decision.threshold,
            mode=decision.mode,
            barrier=_finite(decision.barrier),
            hazard=decision.hazard,
            row=decision.row,
            reason=decision.reason,
            gate_open=decision.gate_open,
            model=model,
            seconds=seconds,
            memory=memory_to_json(decision.memory),
        )

    @classmethod
    def safe(cls, reason: str, seconds: float) -> Self:
        """The reply that the client makes itself when it got none: zero thrust."""
        return cls(
            action=list(SAFE_ACTION),
            nominal_action=None,
            risk=None,
            threshold=None,
            mode="fallback",
            barrier=None,
            hazard=None,
            row=None,
            reason=reason,
            gate_open=True,
            model=None,
            seconds=seconds,
            memory=None,
        )


class ModelReply(BaseModel):
    """The reply of `GET /model`.

    Attributes:
        model: the bundle's id.
        task: gymnasium id of the task it was trained on.
        level: the task's level.
        algorithm: what trained it.
        sha256: file name → SHA-256.
        observation_size: count of the observation's numbers.
        observation_layout: its blocks, in order.
        action_low: lower bounds of the action.
        action_high: upper bounds of the action.
        hazard_radius: radius of a hazard [m].
        gate: when the filter is active: risk, always, off.
        threshold: the gate `risk` activates the filter where the risk score is above this.
        threshold_source: how the bundle's threshold was set.
    """

    model: str
    task: str
    level: int
    algorithm: str
    sha256: dict[str, str]
    observation_size: int
    observation_layout: list[ObservationBlock]
    action_low: Pair
    action_high: Pair
    hazard_radius: Finite
    gate: Gate
    threshold: Finite
    threshold_source: str

    @classmethod
    def of(cls, monitor: Monitor) -> Self:
        """The reply that tells what a monitor runs."""
        bundle: Bundle = monitor.bundle
        manifest = bundle.manifest
        overridden = monitor.threshold != manifest.threshold
        return cls(
            model=bundle.id,
            task=manifest.task,
            level=manifest.level,
            algorithm=manifest.algorithm,
            sha256=dict(manifest.sha256.items()),
            observation_size=manifest.observation_size,
            observation_layout=list(manifest.observation_layout),
            action_low=list(manifest.action_low),
            action_high=list(manifest.action_high),
            hazard_radius=manifest.hazard_radius,
            gate=monitor.gate,
            threshold=monitor.threshold,
            threshold_source="set when the service was started" if overridden else manifest.threshold_source,
        )


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _finite_pair(pair: NDArray[np.float64]) -> list[float] | None:
    return pair.tolist() if np.isfinite(pair).all() else None
