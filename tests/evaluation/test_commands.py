"""`lagnet-evaluate` as it is typed, and the demo's pictures."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from PIL import Image
from rich.console import Console

from decision import Mode, OpenedBy
from evaluation import demo
from evaluation.closed_loop import run_episodes
from evaluation.pictures import draw_drives, drive
from guide import DEFAULT_STRENGTH


def command(module: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_evaluate_prints_tables_and_writes_the_figures(tiny_bundle: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    asked = ("--episodes", 2, "--gate", "always", "--guide", "off", "--hazards", "both", "--seed", 1)
    result = command("evaluation.evaluate", tiny_bundle, *asked, "--json", figures)
    assert result.returncode == 0, result.stderr
    words = ("return", "violating", "95 %", "gate open", "interventions", "p50 / p99", "lidar alone", "given")
    for word in words:
        assert word in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 100
    content = json.loads(figures.read_text())
    assert content["asked"]["episodes"] == 2
    assert content["decided_by"]["gate"] == "always"
    assert content["decided_by"]["guide"] == "off"
    assert set(content["hazards"]) == {"lidar", "given"}
    for source in content["hazards"].values():
        summary, each = source["summary"], source["each_episode"]
        assert sum(each["return"]) / 2 == pytest.approx(summary["return_mean"])
        assert sum(each["open_steps"]) == summary["opened_by"]["always"] == summary["steps"] == 2000
        assert sum(each["interventions"]) == summary["interventions"] > 0
        assert summary["origins"]["guide"] == 0


def test_by_default_the_filter_knows_what_the_task_promises(tiny_bundle: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    result = command("evaluation.evaluate", tiny_bundle, "--episodes", 1, "--json", figures)
    assert result.returncode == 0, result.stderr
    content = json.loads(figures.read_text())
    assert set(content["hazards"]) == {"lidar"}
    assert content["decided_by"]["guide"] == DEFAULT_STRENGTH
    assert content["decided_by"]["threshold"] == 0.5


WRONG = [("--episodes", 0), ("--seed", -1), ("--timeout", "nan")]


@pytest.mark.parametrize(
    ("module", "wrong"),
    [
        *(("evaluation.evaluate", wrong) for wrong in [*WRONG, ("--json", "/nowhere/at/all.json")]),
        *(("evaluation.demo", wrong) for wrong in WRONG),
    ],
)
def test_what_cannot_be_run_is_one_line(tiny_bundle: Path, tmp_path: Path, module: str, wrong) -> None:
    result = command(module, tiny_bundle, *wrong, *(("--out", tmp_path) if "demo" in module else ()))
    assert (result.returncode, result.stdout.strip()) == (2, "")
    (line,) = result.stderr.strip().splitlines()
    assert wrong[0] in line


@pytest.fixture
def shown(scripted, tmp_path: Path):
    """What the demo leaves of scripted robots."""

    def closed(step: int):
        return Mode.NOMINAL, "", "", False

    def always(step: int):
        mode, origin, _, certified = scripted().says(step)
        return mode, origin, OpenedBy.ALWAYS, certified

    says = {"off": closed, "risk": None, "always": always}
    runs = {
        gate: run_episodes(
            "PointGoal1-v0", scripted((1.0, 0.1 if gate == "always" else 0.25), say), 2, record=True
        )
        for gate, say in says.items()
    }
    demo.show(runs, tmp_path, 0.5, "two episodes", Console(quiet=True))
    return runs, tmp_path


def test_the_demo_leaves_a_table_a_picture_and_an_animation(shown) -> None:
    runs, out = shown
    assert "gate risk" in (out / "table.txt").read_text()
    assert set(json.loads((out / "summary.json").read_text())) == set(demo.GATES) == set(runs)
    with Image.open(out / "episode.png") as picture:
        assert min(picture.size) > 800
    with Image.open(out / "episode.gif") as animation:
        assert animation.n_frames > 50
    assert (out / "episode.gif").stat().st_size < 2_000_000


def colours_of(path: Path) -> set[str]:
    """Those that a picture has more than a few points of."""
    pixels = np.round(image.imread(path)[..., :3] * 255).astype(np.uint8).reshape(-1, 3)
    colours, counts = np.unique(pixels, axis=0, return_counts=True)
    return {f"#{r:02x}{g:02x}{b:02x}" for (r, g, b), count in zip(colours, counts, strict=True) if count > 30}


def test_the_picture_shows_what_opened_the_gate_and_what_was_sent(shown, tmp_path: Path) -> None:
    runs, _ = shown
    drives = {gate: drive(episodes.trajectory, 0) for gate, episodes in runs.items()}
    risk, barrier, always = "#7b2cbf", "#70a80b", "#0077b6"
    filtered, guided = "#f48c06", "#4cc9f0"
    draw_drives(tmp_path / "all.png", drives, 0.5, "all")
    assert {risk, barrier, always, filtered, guided} <= colours_of(tmp_path / "all.png")
    draw_drives(tmp_path / "off.png", {"off": drives["off"]}, 0.5, "off")
    assert not {barrier, always} & colours_of(tmp_path / "off.png")


def test_the_picture_of_gates_that_part_is_another(shown, tmp_path: Path) -> None:
    runs, _ = shown
    risk, always = (drive(runs[gate].trajectory, 0) for gate in ("risk", "always"))
    for name, drives in (
        ("apart", {"risk": risk, "always": always}),
        ("same", {"risk": risk, "always": risk}),
    ):
        draw_drives(tmp_path / f"{name}.png", drives, 0.5, "title")
    apart, same = (image.imread(tmp_path / f"{name}.png") for name in ("apart", "same"))
    panels = slice(int(apart.shape[0] * 0.15), int(apart.shape[0] * 0.5))
    assert (apart[panels] != same[panels]).any(axis=-1).mean() > 0.005
