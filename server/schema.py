"""What goes over the wire. No field of a reply can hold NaN or Inf: what is unknown is null.

The client reads this file as well, so it needs neither the monitor nor the bundles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from types import GenericAlias
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, create_model

from decision import PLAN_STEPS, Decision, Mode, OpenedBy, Origin, unpack

if TYPE_CHECKING:
    from monitor import Monitor

FloatArray = NDArray[np.float64]

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""A JSON number; not a string, not a bool, not NaN or Inf in any spelling."""
Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]
RequestNumber = Annotated[int, Field(strict=True, ge=0, lt=2**63)]
RobotName = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z0-9_.:-]{1,64}$")]
Stamp = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1e10)]
"""Seconds of a clock; a double still tells microseconds at the largest."""
MAX_HAZARDS = 1000
"""Most hazards a request may name."""
MAX_ROBOTS = 256
"""Most robots of a batch."""
MAX_MEMORY = 4096
"""Most characters of a memory; what is no memory for other reasons is lost, not refused."""
Sealed = Annotated[str, Field(strict=True, max_length=MAX_MEMORY)]
HazardIndex = Annotated[int, Field(strict=True, ge=0, lt=2 * MAX_HAZARDS)]
"""The request's hazards are counted first, then what the lidar shows."""


class ActRequest(BaseModel):
    """The body of `POST /act`.

    Attributes:
        observation: the numbers of the bundle's observation layout, in its order.
        hazards: centres of the hazards in the body frame [m], x ahead, y left; left out, the lidar is
            decoded.
        memory: the `memory` of this robot's last reply, unchanged; left out before its first step.
        played: for how many control steps the robot has gone on by itself since that reply, by its `plan`.
        request: any whole number; the reply repeats it, so that its sender knows which request it answers.
        robot: the robot's name, by which the service tells robots apart whichever way they come; at most 64
            letters, digits and "_.:-".
        stamp: when the observation was made, by the robot's own clock, whose zero may be anywhere [s]; takes
            `robot`. It never goes back.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    observation: Annotated[list[Finite], Field(min_length=1)]
    hazards: Annotated[list[Pair], Field(max_length=MAX_HAZARDS)] | None = None
    memory: Sealed | None = None
    played: RequestNumber = 0
    request: RequestNumber = 0
    robot: RobotName | None = None
    stamp: Stamp | None = None


class Reply(BaseModel):
    """What a reply of `POST /act` says beside the decision.

    Attributes:
        gate_open: whether the filter was active.
        gate: when the filter is active: risk, always, off.
        memory: the robot's, sealed, to come back with its next request.
        model: the bundle's id.
        plan: what is left of the certified plan: the actions that are safe to send next, one a control step,
            if no further reply comes; after them the robot coasts.
        request: the request's number.
        seconds: how long the decision took [s].
    """

    model_config = ConfigDict(frozen=True, strict=True)

    gate_open: bool
    gate: str
    memory: Sealed
    model: str
    plan: Annotated[list[Pair], Field(max_length=PLAN_STEPS)]
    request: RequestNumber
    seconds: Finite


class Wire(NamedTuple):
    """How a field of `Decision` goes over the wire."""

    kind: Any
    """Its type there."""
    write: Callable[[Any], Any] | None = None
    """From the decision's value; None: as it is."""
    read: Callable[[Any], Any] | None = None
    """To the decision's value; None: as it is."""


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _finite_pair(pair: FloatArray) -> list[float] | None:
    numbers: list[float] = pair.tolist()
    return numbers if all(map(math.isfinite, numbers)) else None


def _pair(value: list[float] | None) -> FloatArray:
    return np.full(2, np.nan) if value is None else np.array(value, np.float64)


def _memory(value: str) -> np.void:
    memory: np.void = unpack(value)[0]
    return memory


_AS_IT_IS = (Mode, bool, Origin | None, OpenedBy | None, str | None)
_WIRE: dict[Any, Wire] = {
    FloatArray: Wire(Pair | None, _finite_pair, _pair),
    float: Wire(Finite | None, _finite, _number),
    int | None: Wire(HazardIndex | None),
    np.void: Wire(Sealed, None, _memory),
    **{kind: Wire(kind) for kind in _AS_IT_IS},
}
"""A field's type in `Decision` → how it goes over the wire."""


def _wires() -> dict[str, Wire]:
    """How every field of `Decision` goes over the wire.

    Raises:
        TypeError: if it has a field of a type for which that is not settled.
    """
    kinds = get_type_hints(Decision)
    wires = {}
    for field in fields(Decision):
        if kinds[field.name] not in _WIRE:
            raise TypeError(f"Decision.{field.name} has a type that the wire does not know")
        wires[field.name] = _WIRE[kinds[field.name]]
    # Whatever else is unknown, a robot is never sent an action that is none.
    return wires | {"action": wires["action"]._replace(kind=Pair)}


_FIELDS = _wires()
_WRITERS = [(name, wire.write) for name, wire in _FIELDS.items() if name != "memory"]
_DEFINITIONS: dict[str, Any] = {name: (wire.kind, ...) for name, wire in _FIELDS.items()}

ActReply = create_model(
    "ActReply",
    __base__=Reply,
    __doc__="The reply of `POST /act`: the fields of `decision.Decision`, and those of `Reply`.",
    **_DEFINITIONS,
)


def reply_of(
    decision: Decision, memory: str, request: int, model: str, gate: str, seconds: float
) -> dict[str, Any]:
    """What tells a decision, as `ActReply` reads it from JSON.

    Args:
        decision: what is told.
        memory: its memory, as it leaves.
        request: the request's number.
        model: the bundle's id.
        gate: when the filter is active.
        seconds: how long the decision took [s].

    Raises:
        ValueError: if its action is no action.
    """
    told: dict[str, Any] = {}
    for name, write in _WRITERS:
        value = getattr(decision, name)
        told[name] = value if write is None else write(value)
    if told["action"] is None:
        raise ValueError(f"the action is {decision.action.tolist()}")
    return told | {
        "memory": memory,
        "gate_open": decision.gate_open,
        "gate": gate,
        "model": model,
        "plan": decision.plan.tolist(),
        "request": request,
        "seconds": seconds,
    }


class BatchRequest(BaseModel):
    """The body of `POST /act/batch`.

    Attributes:
        robots: for each robot the body of a `POST /act`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    robots: Annotated[list[Any], Field(min_length=1, max_length=MAX_ROBOTS)]


class Refusal(BaseModel):
    """The answer to a robot whose request is not in order, as `POST /act` gives it with status 422.

    Attributes:
        detail: what is wrong with it.
    """

    detail: list[dict[str, Any]]


_REPLIES: dict[str, Any] = {"replies": (GenericAlias(list, (ActReply | Refusal,)), ...)}

BatchReply = create_model(
    "BatchReply",
    __doc__="The reply of `POST /act/batch`: for each robot, in order, the reply of `POST /act`.",
    **_REPLIES,
)


def decision_of(reply: Reply) -> Decision:
    """The decision that an `ActReply` tells.

    Raises:
        ValueError: if its memory is none.
    """
    told = {}
    for name, wire in _FIELDS.items():
        value = getattr(reply, name)
        told[name] = value if wire.read is None else wire.read(value)
    return Decision(**told)


class Block(BaseModel):
    """One named run of numbers in the observation, as in `pointgoal.observation.Block`.

    Attributes:
        name: the sensor.
        start: index of its first number.
        size: how many numbers.
        unit: their unit; "1" for dimensionless readings.
    """

    name: str
    start: int
    size: int
    unit: str


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
        robot: the robot's constants, name → number, as `system.Robot` names them.
        gate: when the filter is active: risk, always, off.
        threshold: the gate `risk` activates the filter where the risk score is above this.
        threshold_source: how the bundle's threshold was set.
        guide: how much the guide may do: off, refusal, ahead.
    """

    model: str
    task: str
    level: int
    algorithm: str
    sha256: dict[str, str]
    observation_size: int
    observation_layout: list[Block]
    action_low: Pair
    action_high: Pair
    hazard_radius: Finite
    robot: dict[str, Finite]
    gate: str
    threshold: Finite
    threshold_source: str
    guide: str

    @classmethod
    def of(cls, monitor: Monitor) -> Self:
        """The reply that tells what a monitor runs."""
        manifest = monitor.bundle.manifest
        gate = monitor.gate
        overridden = gate.threshold != manifest.threshold
        return cls(
            model=monitor.bundle.id,
            task=manifest.task,
            level=manifest.level,
            algorithm=manifest.algorithm,
            sha256=dict(manifest.sha256.items()),
            observation_size=manifest.observation_size,
            observation_layout=[Block(**block.model_dump()) for block in manifest.observation_layout],
            action_low=list(manifest.action_low),
            action_high=list(manifest.action_high),
            hazard_radius=manifest.hazard_radius,
            robot=monitor.robot._asdict(),
            gate=gate.name,
            threshold=gate.threshold,
            threshold_source="set when the service was started" if overridden else manifest.threshold_source,
            guide=monitor.guide,
        )
