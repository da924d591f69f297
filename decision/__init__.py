"""What one control step comes to: the action to send, why, and what the robot's monitor remembers of it.

Every room speaks these types: the filter fills them, the monitor adds the risk score and the gate, the
service sends one row of them, its client gives that row back, and the evaluation counts them.
"""

from decision.decider import BatchDecider, Decider
from decision.decision import SAFE_ACTION, Decision, Decisions, Mode, OpenedBy, Origin, texts, unknown
from decision.fallback import fall_back
from decision.faults import Faults
from decision.hazards import hazards_of_one
from decision.memory import (
    HISTORY,
    MEMORY,
    MOST_LATE,
    MOST_OPEN,
    PLAN_STEPS,
    SENSED,
    Memory,
    copy_of,
    memory_of,
    next_of_plan,
    pack,
    remember_sent,
    unpack,
)
from decision.parts import in_parts
from decision.stopwatch import Stopwatch

__all__ = [
    "HISTORY",
    "MEMORY",
    "MOST_LATE",
    "MOST_OPEN",
    "PLAN_STEPS",
    "SAFE_ACTION",
    "SENSED",
    "BatchDecider",
    "Decider",
    "Decision",
    "Decisions",
    "Faults",
    "Memory",
    "Mode",
    "OpenedBy",
    "Origin",
    "Stopwatch",
    "copy_of",
    "fall_back",
    "hazards_of_one",
    "in_parts",
    "memory_of",
    "next_of_plan",
    "pack",
    "remember_sent",
    "texts",
    "unknown",
    "unpack",
]
