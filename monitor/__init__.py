"""The runtime: policy and multiplier network, the gate, and the decision they end in."""

from guide import DEFAULT_STRENGTH, Strength
from inference import NetworkError
from monitor.errors import MonitorError
from monitor.gate import GATES, Gate, GateName
from monitor.monitor import Monitor

__all__ = [
    "DEFAULT_STRENGTH",
    "GATES",
    "Gate",
    "GateName",
    "Monitor",
    "MonitorError",
    "NetworkError",
    "Strength",
]
