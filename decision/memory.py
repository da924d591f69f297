"""What is remembered of a robot from one control step to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLAN_STEPS = 20
"""Control steps for which a plan thrusts at most: 0.4 s; a full brake from top speed takes 0.36 s."""

MEMORY = np.dtype([("side", "i1"), ("guided", "i1"), ("left", "i1"), ("plan", "f8", (PLAN_STEPS, 2))])
"""One robot's memory; zeros before its first step.

- ``side``: the side on which the robot passes what is in its way, 1 left, -1 right, 0 none, times the steps
  for which that is still remembered.
- ``guided``: the side on which the guide is leading the robot past something, 1 left, -1 right, else 0.
- ``left``: how many actions of the plan are left.
- ``plan``: (PLAN_STEPS, 2) what is left of the certified backup, action by action; after it the robot coasts.
"""

Memory = NDArray[np.void]
"""(N,) of `MEMORY`: rows are taken, masked and joined like any array's."""


def next_of_plan(memory: Memory) -> tuple[NDArray[np.float64], Memory]:
    """The plans' next actions (N, 2), coasting where a plan has ended, and the memory without them."""
    action = np.where((memory["left"] > 0)[:, None], memory["plan"][:, 0], 0.0)
    after = memory.copy()
    after["plan"][:, :-1] = memory["plan"][:, 1:]
    after["plan"][:, -1] = 0.0
    after["left"] = np.maximum(memory["left"] - 1, 0)
    return action, after


def memory_to_json(memory: np.void) -> dict[str, Any]:
    """One robot's memory as plain JSON, to be handed back with the next observation."""
    left = int(memory["left"])
    return {
        "side": int(memory["side"]),
        "guided": int(memory["guided"]),
        "plan": memory["plan"][:left].tolist(),
    }


def memory_from_json(value: Mapping[str, Any]) -> Memory:
    """The inverse of `memory_to_json`: the memory (1,) of one robot.

    Raises:
        ValueError: if the value is not a memory that this version wrote; the message names the field.
    """
    memory = np.zeros(1, MEMORY)
    if set(value) != {"side", "guided", "plan"}:
        raise ValueError(f"memory has the fields {sorted(value)}, expected guided, plan, side")
    for name, least in (("side", -127), ("guided", -1)):
        number = value[name]
        if isinstance(number, bool) or not isinstance(number, int) or not least <= number <= -least:
            raise ValueError(f"memory.{name} must be a whole number in {least}..{-least}, got {number!r}")
        memory[name] = number
    try:
        plan = np.asarray(value["plan"], dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError) as error:
        raise ValueError("memory.plan must be a list of pairs of numbers") from error
    if len(plan) > PLAN_STEPS or not (np.abs(plan) <= 1.0).all():
        raise ValueError(f"memory.plan must hold at most {PLAN_STEPS} pairs of numbers in -1..1")
    memory["left"] = len(plan)
    memory["plan"][0, : len(plan)] = plan
    return memory
