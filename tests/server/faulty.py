"""`lagnet-serve` with faults in it: what an observation begins with says which.

python tests/server/faulty.py BUNDLE --port 0 ...
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from filter import BarrierFilter
from inference import Networks
from server.serve import main

NAN, SLOW, HANGS, CRASHES = 11.0, 12.0, 13.0, 14.0

run, decide = Networks.run, BarrierFilter.decide


def faulty_run(self: Networks, observation: Any) -> Any:
    """Networks that give NaN, take 200 ms, or hang."""
    if observation[0, 0] == SLOW:
        threading.Event().wait(0.2)
    if observation[0, 0] == HANGS:
        threading.Event().wait()
    action, risk = run(self, observation)
    return (np.full_like(action, np.nan), risk) if observation[0, 0] == NAN else (action, risk)


def faulty_decide(self: BarrierFilter, view: Any, *arguments: Any) -> Any:
    """A filter that crashes."""
    if view.observation[0, 0] == CRASHES:
        raise ZeroDivisionError("a fault in the filter")
    return decide(self, view, *arguments)


Networks.run = faulty_run
BarrierFilter.decide = faulty_decide

if __name__ == "__main__":
    main()
