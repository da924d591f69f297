"""Who may import whom, and that the commands which the README names exist."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "pointgoal": set(),
    "models": set(),
    "filter": {"pointgoal.observation"},
    "trainer": {"pointgoal", "models", "filter"},
    "monitor": {"models", "filter", "pointgoal.observation"},
    "server": {"monitor", "models", "pointgoal.observation"},
    "evaluation": {"pointgoal", "models", "filter", "trainer", "monitor", "server"},
}
HEAVY = {"torch", "mujoco", "gymnasium", "matplotlib", "PIL", "scipy", "ray", "tensorboard"}
RUNTIME = ("models", "filter", "monitor", "server")
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def imports(path: Path, top_level_only: bool = False) -> Iterator[str]:
    """Names of the modules that a file imports."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_what_it_may(room: str) -> None:
    allowed = MAY_IMPORT[room] | {room}
    for path in (ROOT / room).rglob("*.py"):
        for module in imports(path):
            if module.split(".")[0] in MAY_IMPORT:
                assert any(module == name or module.startswith(f"{name}.") for name in allowed), (
                    path,
                    module,
                )


@pytest.mark.parametrize("room", RUNTIME)
def test_the_runtime_imports_nothing_heavy_at_its_top(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        assert not {module.split(".")[0] for module in imports(path, top_level_only=True)} & HEAVY, path


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_command_explains_itself(script: str) -> None:
    command = Path(sys.executable).with_name(script)
    result = subprocess.run([command, "--help"], capture_output=True, text=True, check=True)
    assert "usage:" in result.stdout
