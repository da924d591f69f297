"""The runtime: policy and multiplier network, the gate, and the decision they end in."""

from monitor.errors import MonitorError, NetworkError
from monitor.gate import GATES, Gate, GateName
from monitor.monitor import Monitor

__all__ = ["GATES", "Gate", "GateName", "Monitor", "MonitorError", "NetworkError"]
