"""`lagnet-evaluate` and the demo as they are typed, and that nothing they start outlives them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from evaluation.service import Service, ServiceError


def command(module: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def services_of(bundle: Path) -> list[int]:
    """Processes that serve a bundle."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"server.serve" in words and str(bundle).encode() in words:
                found.append(int(folder.name))
    return found


def test_evaluate_prints_a_table_and_writes_the_figures(tiny_bundle: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    result = command(
        "evaluation.evaluate", tiny_bundle, "--episodes", 2, "--gate", "always", "--json", figures
    )
    assert result.returncode == 0, result.stderr
    for words in ("return", "violating steps", "95 % interval", "interventions", "decision p50 / p99"):
        assert words in result.stdout
    content = json.loads(figures.read_text())
    assert content["asked"]["episodes"] == content["summary"]["episodes"] == 2
    assert content["decided_by"]["gate"] == "always"
    assert sum(content["each_episode"]["return"]) / 2 == pytest.approx(content["summary"]["return_mean"])


def test_evaluate_says_in_one_line_what_is_wrong(tiny_bundle: Path) -> None:
    result = command("evaluation.evaluate", tiny_bundle, "--url", "http://127.0.0.1:1")
    assert (result.returncode, result.stdout.strip()) == (2, "")
    (line,) = result.stderr.strip().splitlines()
    assert "http://127.0.0.1:1" in line


def test_a_gate_that_is_not_the_services_is_refused(tiny_bundle: Path, monkeypatch) -> None:
    # A key of the user's own services is none of this one's.
    monkeypatch.setenv("LAGNET_API_KEY", "sesame")
    with Service.start(tiny_bundle, "off") as service:
        asked = ("evaluation.evaluate", tiny_bundle, "--url", service.url)
        for given, named in ((("--gate", "always"), "gate off"), (("--threshold", "0.1"), "threshold 0.5")):
            result = command(*asked, *given)
            assert result.returncode == 2
            assert named in result.stderr


@pytest.mark.parametrize("wrong", [("--episodes", 0), ("--seed", -1), ("--timeout", "nan")])
def test_a_demo_that_cannot_be_run_is_one_line(tiny_bundle: Path, tmp_path: Path, wrong) -> None:
    result = command("evaluation.demo", tiny_bundle, "--out", tmp_path, *wrong)
    assert result.returncode == 2
    (line,) = result.stderr.strip().splitlines()
    assert wrong[0] in line


def test_the_demo_leaves_a_table_a_picture_and_an_animation(tiny_bundle: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    result = command("evaluation.demo", tiny_bundle, "--out", out, "--episodes", 1)
    assert result.returncode == 0, result.stderr
    assert "gate risk" in (out / "table.txt").read_text()
    assert set(json.loads((out / "summary.json").read_text())) == {"off", "risk", "always"}
    with Image.open(out / "episode.png") as picture:
        assert min(picture.size) > 800
    with Image.open(out / "episode.gif") as animation:
        assert animation.n_frames > 50
    assert (out / "episode.gif").stat().st_size < 2_000_000
    assert services_of(tiny_bundle) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_stops_its_service(
    own_bundle: Path, tmp_path: Path, number: signal.Signals
) -> None:
    demo = subprocess.Popen(
        [sys.executable, "-m", "evaluation.demo", str(own_bundle), "--out", str(tmp_path / "demo")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 60.0
        while not services_of(own_bundle):
            assert demo.poll() is None, demo.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        demo.send_signal(number)
        assert demo.wait(30.0) == 130
        assert "Traceback" not in demo.stderr.read()
        assert services_of(own_bundle) == []
    finally:
        demo.kill()
        demo.wait()
        for left in services_of(own_bundle):
            os.kill(left, signal.SIGKILL)


def test_a_service_that_does_not_start_tells_why(own_bundle: Path) -> None:
    (own_bundle / "policy.onnx").unlink()
    with pytest.raises(ServiceError, match=r"policy\.onnx"):
        Service.start(own_bundle, "off")
