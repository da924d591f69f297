"""What is remembered of a robot from one control step to the next."""

from __future__ import annotations

import base64

import numpy as np
from numpy.typing import ArrayLike, NDArray

PLAN_STEPS = 20
"""Control steps for which a plan thrusts at most: 0.4 s; a full brake from top speed takes 0.36 s."""

SENSED = 60
"""Numbers of an observation that are remembered, at most."""

MOST_OPEN = 1000
"""Control steps for which a gate stays open at most: 20 s."""

MOST_LATE = 5
"""Control steps by which an action's effect may be late at most, see `filter.FilterConfig.delay_steps`."""

HISTORY = np.dtype(
    [
        ("sent", "f4", (MOST_LATE + 1, 2)),
        ("sensed", "f4", (SENSED,)),
        ("age", "i4"),
        ("doubted", "i4"),
    ],
    align=True,
)
"""What a robot was sent and what it saw, to compare with what it sees next.

- ``sent``: the last actions, the newest first.
- ``sensed``: the last observation, as long as it is; zeros behind it.
- ``age``: for how many control steps it is the last one; 0: there is none.
- ``doubted``: 1 once a sensor that the filter steers by was caught; only a new memory trusts it again.
"""

MEMORY = np.dtype(
    [
        ("plan", "f8", (PLAN_STEPS, 2)),
        ("side", "i2"),
        ("left", "i2"),
        ("open", "i2"),
        ("guided", "i1"),
        ("planned", "?"),
        ("history", HISTORY),
        ("seal", "i8", 4),
    ],
    align=True,
)
"""One robot's memory; zeros before its first step.

- ``side``: the side on which the robot passes what is in its way, 1 left, -1 right, 0 none, times the steps
  for which that is still remembered.
- ``open``: for how many more control steps the gate stays open, whatever opened it.
- ``guided``: the side on which the guide is leading the robot past something, 1 left, -1 right, else 0.
- ``planned``: whether there is a certified plan; one without actions is to coast.
- ``left``: how many actions of the plan are left.
- ``history``: see `HISTORY`.
- ``seal``: by what a service knows a memory that it sent: its number, that
  of the first of a robot without a name, and a tag; zeros: none has.
- ``plan``: (PLAN_STEPS, 2) what is left of the certified backup, action by action; after it the robot coasts.
"""

_WHOLE = np.dtype(f"V{MEMORY.itemsize}")
Memory = NDArray[np.void]
"""(N,) of `MEMORY`: rows are taken, masked and joined like any array's."""


def memory_of(count: int, memory: Memory | np.void | None) -> Memory:
    """The memory (count,) of so many robots; None is that before a first step.

    Raises:
        ValueError: if it is not that of so many robots.
    """
    if memory is None:
        return np.zeros(count, MEMORY)
    if getattr(memory, "dtype", None) != MEMORY or memory.size != count:
        raise ValueError(f"the memory is not that of {count} robot{'s' * (count != 1)}")
    return np.ascontiguousarray(memory).reshape(count)


def copy_of(memory: Memory) -> Memory:
    """A copy of N robots' memory, whole: numpy would copy field by field, for 3 us."""
    return memory.view(_WHOLE).copy().view(MEMORY)


def next_of_plan(memory: Memory) -> tuple[NDArray[np.float64], Memory]:
    """The plans' next actions (N, 2), coasting where a plan has ended, and the memory without them.

    A memory that no filter wrote moves nothing: an action that is none ends its plan.
    """
    action = memory["plan"][:, 0]
    going = (memory["left"] > 0) & (np.abs(action) <= 1.0).all(axis=1)
    action = np.where(going[:, None], action, 0.0)
    after = copy_of(memory)
    after["plan"][:, :-1] = memory["plan"][:, 1:]
    after["plan"][:, -1] = 0.0
    after["left"] = np.where(going, np.minimum(memory["left"], PLAN_STEPS) - 1, 0)
    return action, after


def remember_sent(memory: Memory, action: ArrayLike) -> None:
    """Write down what N robots are sent (N, 2), in a control step in which nothing new was seen."""
    history = memory["history"]
    history["sent"][:, 1:] = history["sent"][:, :-1].copy()
    history["sent"][:, 0] = action
    history["age"] += history["age"] > 0


def pack(memory: bytes) -> str:
    """One robot's memory as text, to be handed back with the next observation: base64."""
    return base64.b64encode(memory).decode("ascii")


def unpack(text: str) -> Memory:
    """The inverse of `pack`: the memory (1,) of one robot. What is in it is as good as whoever sent it.

    Raises:
        ValueError: if the text is not as long as a memory, or its plan is none.
    """
    try:
        data = base64.b64decode(text, validate=True)
    except ValueError:
        data = b""
    if len(data) != MEMORY.itemsize:
        raise ValueError(f"memory must be the base64 of {MEMORY.itemsize} bytes")
    memory: Memory = np.frombuffer(bytearray(data), MEMORY)
    if not 0 <= memory["left"].item() <= PLAN_STEPS:
        raise ValueError(f"memory has a plan of {memory['left'].item()} actions, not of 0 to {PLAN_STEPS}")
    return memory
