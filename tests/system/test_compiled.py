"""Where machine code is kept, for users who can write nearly nowhere: containers, systemd's DynamicUser."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("decision", "system", "filter", "guide", "inference", "novelty", "monitor", "models", "pointgoal")
_DROP_CAPABILITY, _PAST_PERMISSIONS = 24, (1, 2, 3)

FOLDER = """
import monitor, system.compiled
print(system.compiled.__file__)
print(system.compiled._FOLDER)
"""
NOWHERE = (
    # One that cannot be written to, and none at all.
    "import os, tempfile\ntempfile.tempdir = os.getcwd()",
    "import tempfile\ndef none(): raise FileNotFoundError\ntempfile.gettempdir = none",
)
DECIDES = """
import numpy as np
from monitor import Monitor
monitor = Monitor.load("models/pointgoal1")
observation = np.zeros(60)
observation[28:31] = 0.15, 0.3, 0.15  # a hazard: a scan of nothing is no scan
print(monitor.decide(observation).mode)
"""


def obey_permissions() -> None:
    """In a child before it runs: root, too, is then kept out by permissions."""
    libc = ctypes.CDLL(None)
    for capability in _PAST_PERMISSIONS:
        libc.prctl(_DROP_CAPABILITY, capability, 0, 0, 0)


@pytest.fixture(scope="module")
def read_only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The runtime's source in a folder that cannot be written to, and beside it one that can."""
    top = tmp_path_factory.mktemp("home")
    source = top / "source"
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    (top / "tmp").mkdir()
    folders = [source, *(path for path in source.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    yield top
    for folder in folders:
        folder.chmod(0o755)


def run(top: Path, script: str, temporary: str) -> list[str]:
    """The lines that a script prints, run by a user without a home."""
    inherited = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    environment = {"PYTHONPATH": str(top / "source"), "HOME": "/nonexistent", "TMPDIR": temporary}
    result = subprocess.run(
        [sys.executable, "-c", script],
        env=inherited | environment,
        cwd=top / "source",
        preexec_fn=obey_permissions,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="drops the powers of root as Linux does")
def test_without_a_home_it_is_kept_in_the_temporary_folder_or_not_at_all(read_only: Path) -> None:
    temporary = read_only / "tmp"
    where, folder = run(read_only, FOLDER, str(temporary))
    assert Path(where).is_relative_to(read_only)
    assert Path(folder).is_relative_to(temporary)
    assert Path(folder).parent.stat().st_mode & 0o777 == 0o700
    # What anybody could write there is not run.
    Path(folder).parent.chmod(0o777)
    assert run(read_only, FOLDER, str(temporary))[-1] == "None"
    Path(folder).parent.chmod(0o700)
    for script in NOWHERE:
        assert run(read_only, script + FOLDER, str(temporary))[-1] == "None"


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="drops the powers of root as Linux does")
@pytest.mark.parametrize("temporary", ["there", "nowhere"])
def test_and_decides(read_only: Path, temporary: str) -> None:
    script = DECIDES if temporary == "there" else NOWHERE[0] + DECIDES
    kept = read_only / "tmp"
    assert run(read_only, script, str(kept))[-1] == "nominal"
    assert any(kept.rglob("*.nbi")) == (temporary == "there")
    shutil.rmtree(kept)
    kept.mkdir()
