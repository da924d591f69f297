"""After loading nothing is compiled any more: the first real decision is not the slow one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import logging
import sys
import numpy as np
from decision import MEMORY
from filter import kernel, solvers
from guide import guide
from inference import features, networks
from monitor import Monitor, gate
from novelty import consistency
from pointgoal.lidar import encode

entries = {
    name: entry
    for room in (kernel, solvers, guide, features, networks, gate, consistency)
    for name, entry in vars(room).items()
    if hasattr(entry, "signatures") and entry.__module__ == room.__name__
}
logging.disable()
monitor = Monitor.load(sys.argv[1], sys.argv[3], guide=sys.argv[2])
before = {name: len(entry.signatures) for name, entry in entries.items()}

goal = encode(np.array([[[1.5, 0.0]]]))[0]
for n in (1, 3):
    for places in ([[0.29, 0.03]], [[0.24, 0.0]], [[0.22, 0.0], [-0.23, 0.0]], [[0.1, 0.0]], [[0.7, 0.0]]):
        for ahead in (0.8, 0.0):
            observation = np.zeros((n, 60))
            observation[:, 3] = ahead
            observation[:, 12:28] = goal
            observation[:, 28:44] = encode(np.array([places]))
            for hazards in (np.repeat(np.array([places]), n, axis=0), None):
                memory = np.zeros(n, MEMORY)
                for _ in range(2):
                    memory = monitor.decide_batch(observation, hazards, memory).memory
                # Whatever the caller's arrays look like in memory.
                monitor.decide_batch(observation[::-1], hazards, memory[::-1])
                monitor.decide_batch(np.asfortranarray(observation), hazards, memory)
after = {name: len(entry.signatures) for name, entry in entries.items()}
late = {name: after[name] - before[name] for name in entries if after[name] > before[name]}
assert not late, f"compiled on the way: {late}"
# What robots nowhere in particular see is novel.
faults = {kind for kind in monitor.faults.counts if not kind.startswith("novelty: ")}
assert not faults, faults
"""


def late(bundle: Path, guide: str, gate: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(bundle), guide, gate],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return result.stderr


def test_one_robot_and_many_run_what_was_compiled_at_load(tiny_bundle: Path) -> None:
    assert late(tiny_bundle, "refusal", "always") == ""


def test_nor_are_the_features_or_the_gate_compiled_late() -> None:
    assert late(Path(__file__).parents[2] / "models" / "pointgoal1", "refusal", "risk") == ""
