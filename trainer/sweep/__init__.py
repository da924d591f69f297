"""`lagnet-sweep`: many runs side by side on Ray, on the cores of this machine or on a cluster."""

from trainer.sweep.driver import main, sweep
from trainer.sweep.settings import Sweep

__all__ = ["Sweep", "main", "sweep"]
