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
MAY_IMPORT: dict[str, set[str]] = {
    "command": set(),
    "pointgoal": set(),
    "models": set(),
    "decision": set(),
    "system": {"decision", "pointgoal.observation"},
    "filter": {"decision", "system", "pointgoal.observation"},
    "guide": {"decision", "system", "filter", "pointgoal.observation"},
    "inference": {"models", "system.compiled", "pointgoal.observation"},
    "trainer": {"command", "pointgoal", "models", "decision", "system", "filter", "guide"},
    "novelty": {"decision", "system", "pointgoal.observation"},
    "monitor": {
        *("decision", "system", "filter", "guide", "inference", "novelty", "models", "pointgoal.observation"),
    },
    "recorder": set(),
    "server": {
        *("command", "decision", "monitor", "models", "filter", "guide", "recorder", "pointgoal.observation"),
        *("system.outlook", "system.point_robot"),
    },
    "evaluation": {
        *(
            "command",
            "pointgoal",
            "models",
            "decision",
            "system",
            "filter",
            "guide",
            "inference",
            "novelty",
            "trainer",
            "monitor",
            "recorder",
            "server",
        ),
    },
}
MOST_LINES = {"filter": 2000, "monitor": 500}
"""The project's own bounds: what no longer fits does a second job."""
MOST_LINES_OF_THE_FILTERS_CLASS = 150
HEAVY = {"torch", "mujoco", "gymnasium", "matplotlib", "PIL", "scipy", "ray", "tensorboard"}
RUNTIME = (
    *("command", "models", "decision", "system", "filter", "guide", "inference", "novelty", "monitor"),
    *("recorder", "server"),
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SCRIPTS = PROJECT["project"]["scripts"]


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


def test_every_room_is_installed_and_typed() -> None:
    assert set(MAY_IMPORT) <= set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    assert set(MAY_IMPORT) <= set(PROJECT["tool"]["mypy"]["packages"])


@pytest.mark.parametrize("room", [*MAY_IMPORT, "benchmarks"])
def test_no_import_is_of_what_is_gone(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        for module in imports(path):
            first = module.split(".")[0]
            if first in MAY_IMPORT:
                place = ROOT.joinpath(*module.split("."))
                assert place.is_dir() or place.with_suffix(".py").is_file(), (path, module)


@pytest.mark.parametrize("room", MOST_LINES)
def test_a_room_stays_small(room: str) -> None:
    lines = sum(len(path.read_text().splitlines()) for path in (ROOT / room).rglob("*.py"))
    assert lines <= MOST_LINES[room]


def test_the_filters_class_can_be_read_in_one_sitting() -> None:
    tree = ast.parse((ROOT / "filter" / "barrier_filter.py").read_text())
    [found] = [n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == "BarrierFilter"]
    assert found.end_lineno is not None
    assert found.end_lineno - found.lineno + 1 <= MOST_LINES_OF_THE_FILTERS_CLASS


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_command_explains_itself(script: str) -> None:
    command = Path(sys.executable).with_name(script)
    result = subprocess.run([command, "--help"], capture_output=True, text=True, check=True)
    assert "usage:" in result.stdout
