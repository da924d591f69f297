"""The runtime: policy and multiplier network, the gate, and the decision they end in."""

from filter import SAFE_ACTION
from monitor.decision import Decision, DecisionBatch, ModeName
from monitor.errors import MonitorError, NetworkError
from monitor.memory import memory_from_json, memory_to_json
from monitor.monitor import GATES, Gate, Monitor

__all__ = [
    "GATES",
    "SAFE_ACTION",
    "Decision",
    "DecisionBatch",
    "Gate",
    "ModeName",
    "Monitor",
    "MonitorError",
    "NetworkError",
    "memory_from_json",
    "memory_to_json",
]
