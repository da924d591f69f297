"""Whether what a robot sees is what it should see, by physics and by what its policy has seen so far."""

from novelty.consistency import GROUPS, STEERED_BY
from novelty.watch import FLOORS, Findings, Normal, Watch, calibrate, learn, nothing

__all__ = ["FLOORS", "GROUPS", "STEERED_BY", "Findings", "Normal", "Watch", "calibrate", "learn", "nothing"]
