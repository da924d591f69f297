"""Commands as they are typed: text as it is, an orderly end, and errors before long work."""

from __future__ import annotations

import io
import os
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from command import hint, terminal, why_not_file, why_not_folder
from trainer.report import Bar
from trainer.train import bundle_name

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"])


def start(script: str, *arguments: object, **options) -> subprocess.Popen:
    command = [Path(sys.executable).with_name(script), *map(str, arguments)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    return subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, **streams)


def run(script: str, *arguments: object, **options) -> tuple[int, str, str]:
    process = start(script, *arguments, **options)
    out, error = process.communicate(timeout=120)
    return process.returncode, out, error


@pytest.mark.parametrize("scripts", [SCRIPTS[:3], SCRIPTS[3:]])
def test_every_command_says_its_version_and_ends_quietly_when_nobody_reads(scripts: list[str]) -> None:
    assert len(SCRIPTS) >= 6
    versions = {script: start(script, "--version") for script in scripts}
    for script, process in versions.items():
        out, error = process.communicate(timeout=120)
        assert (process.returncode, error) == (0, "")
        assert out.startswith(f"{script} ")
        assert len(out.split()) == 2
    helps = {}
    for script in scripts:
        read, write = os.pipe()
        helps[script] = start(script, "--help", stdout=write)
        os.close(write)
        os.close(read)  # a reader that has gone before the first word
    for script, process in helps.items():
        _, error = process.communicate(timeout=120)
        assert error == "", script
        assert process.returncode not in (0, 120), script


SHORT = ("--task", "PointGoal0-v0", "--num-envs", "4", "--epoch-steps", "400", "--minibatch", "100",
         "--passes", "1", "--threads", "1", "--no-tensorboard")  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "[seed0] a[/b]c :smile: $x$ it's 5%",
        pytest.param("[/]", marks=pytest.mark.long),
        pytest.param('-dash & more; "quoted"', marks=pytest.mark.long),
    ],
)
def test_names_come_out_as_they_went_in_and_hints_can_be_pasted(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    status, _, error = run("lagnet-train", "--out", folder, "--total-steps", 800, *SHORT)
    assert status == 0, error
    assert f"steps/s): {folder}\n" in error
    # Redirected: one line an epoch.
    lines = [line for line in error.splitlines() if "steps · return" in line]
    assert [line.split(" ")[0] for line in lines] == ["400/800", "800/800"]
    (hinted,) = [line for line in error.splitlines() if line.startswith("go on with: ")]
    command, run_folder, bundle = shlex.split(hinted.removeprefix("go on with: "))
    assert (command, run_folder) == ("lagnet-export", str(folder))
    status, _, error = run("lagnet-train", "--out", folder, "--total-steps", 800, *SHORT)
    assert status == 1
    assert f"continue it with --resume {shlex.quote(str(folder))}" in error
    assert len(error.splitlines()) == 1
    status, _, error = run("lagnet-export", folder, tmp_path / Path(bundle).name, "--episodes", 1)
    assert status == 0, error


def test_export_says_what_is_wrong_before_it_plays(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "notes").write_text("mine")
    for arguments, named in (
        ((tmp_path / "no run", tmp_path / "my bundle"), "'my bundle' is no name for a bundle"),
        ((tmp_path, tmp_path / "b", "--episodes", 0), "--episodes"),
        ((tmp_path, tmp_path / "b", "--threads", -1), "--threads"),
        ((tmp_path, taken), "exists and is not a bundle"),
        ((tmp_path, taken / "notes" / "b"), "is not a folder"),
        ((tmp_path, tmp_path / "b"), "is no run"),
    ):
        status, _, error = run("lagnet-export", *arguments)
        assert status == 1
        assert named in error
        assert len(error.splitlines()) == 1, error


def test_plot_and_evaluate_look_where_they_are_to_write_first(tmp_path: Path) -> None:
    lost = tmp_path / "nowhere" / "x"
    for script, *arguments in (
        ("lagnet-plot", tmp_path, "--out", lost.with_suffix(".png")),
        ("lagnet-evaluate", ROOT / "models" / "pointgoal1", "--json", lost.with_suffix(".json")),
        ("lagnet-evaluate", ROOT / "models" / "pointgoal1", "--json", tmp_path),
    ):
        status, _, error = run(script, *arguments)
        assert status in (1, 2)
        assert "there is no folder" in error or "is a folder" in error
        assert len(error.splitlines()) == 1, error


def test_what_cannot_be_exported_is_told_before_it_is_trained(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    status, _, error = run(
        "lagnet-train", "--algorithm", "scpo", "--out", folder, "--total-steps", 400, *SHORT
    )
    assert status == 0, error
    assert error.splitlines()[0].startswith("note: scpo observes more")
    assert "lagnet-export" not in error.splitlines()[-1]


@dataclass
class Row:
    """One row of a table of a user's names."""

    name: str = "[red]x[/red] :smile: [/b]"


def test_a_terminal_prints_text_as_it_is() -> None:
    console = terminal(file=io.StringIO(), width=40)
    table = Table(title=Row().name)
    table.add_column(Row().name)
    table.add_row(Row().name)
    console.print(table)
    console.print(f"{Row().name} {'x' * 100}")
    text = console.file.getvalue()
    assert text.count(Row().name) == 4
    assert f"{Row().name} {'x' * 100}\n" in text


def test_a_hint_is_read_back_by_a_shell() -> None:
    words = ["lagnet-train", "--out", "a b/[c] 'd' \"e\" $f `g` \\h", "*"]
    assert shlex.split(hint(*words)) == words
    echoed = subprocess.run(["sh", "-c", f"printf '%s\\n' {hint(*words)}"], capture_output=True, check=True)
    assert echoed.stdout.decode().splitlines() == words


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("my run", "my-run"),
        ("[x]", "x-"),
        ("...", "bundle"),
        ("ünï", "n-"),
        ("a" * 90, "a" * 64),
        ("ok-1", "ok-1"),
    ],
)
def test_a_bundle_is_proposed_under_a_name_that_it_may_have(folder: str, name: str) -> None:
    assert bundle_name(Path("/runs") / folder) == name


def test_where_nothing_can_be_written_is_known_before(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert why_not_file(tmp_path / "new") is None
    assert why_not_file(file) is None
    assert why_not_file(tmp_path) == "is a folder"
    assert "there is no folder" in str(why_not_file(tmp_path / "a" / "b"))
    assert why_not_folder(tmp_path / "a" / "b") is None
    assert why_not_folder(file) == "is a file"
    assert "is not a folder" in str(why_not_folder(file / "a"))


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_the_training_bar_fits_its_terminal_and_shows_the_time(width: int) -> None:
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    with Bar(5_000_000, 0, console) as bar:
        row = {"return_100": 27.31, "cost_100": 12.5, "multiplier": 0.75}
        for step in range(3):
            bar.show(20_000 * (step + 1), row, 123_456.0)
    lines = [line for line in console.file.getvalue().replace("\r", "\n").split("\n") if "60,000" in line]
    assert lines
    for line in lines:
        assert "…" not in line
        assert ":" in line.split("━")[0]
    assert ("steps/s" in lines[-1]) == (width == 120)
