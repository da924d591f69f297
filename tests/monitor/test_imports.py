"""The runtime needs none of what training needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys
training = "torch", "mujoco", "gymnasium", "onnxscript", "scipy", "matplotlib", "tensorboard", "safetensors"
for name in training:
    sys.modules[name] = None  # an import of it now raises ImportError
import server, monitor, filter, models
from server.app import create_app
from server.serve import main
loaded = monitor.Monitor.load(sys.argv[1], "always")
assert loaded.decide([0.0] * 60).mode in ("nominal", "filtered")
create_app(loaded)
assert not {"trainer", "evaluation", "pointgoal.vector"} & set(sys.modules)
"""


def test_the_runtime_runs_without_torch_mujoco_and_gymnasium(tiny_bundle: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tiny_bundle)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
