"""Robots that ask a service: it decides as the monitor, it may die, and none that we start outlives us."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evaluation import evaluate
from evaluation.camera import HEIGHT, NONE_HERE, TOO_SHORT, WIDTH, browser
from evaluation.closed_loop import run_episodes
from evaluation.errors import ServiceError
from evaluation.remote import asked
from evaluation.service import Service
from pointgoal.observation import layout


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


@pytest.mark.parametrize("hazards", ["lidar", pytest.param("given", marks=pytest.mark.long)])
def test_the_service_decides_as_the_monitor(tiny_bundle: Path, always, hazards) -> None:
    here = run_episodes("PointGoal1-v0", always, 3, seed=2, hazards=hazards, record=True)
    with (
        Service.start(tiny_bundle, "always") as service,
        asked(service.url, layout(1).to_json(), 5.0) as (robots, served),
    ):
        there = run_episodes("PointGoal1-v0", robots, 3, seed=2, hazards=hazards, record=True)
    assert served.gate == "always"
    assert len(there.seconds) == len(here.seconds) == 1000
    assert here.interventions.sum() > 0
    for name in ("modes", "origins", "opened_by"):
        for kind, count in getattr(here, name).items():
            np.testing.assert_array_equal(count, getattr(there, name)[kind])
    np.testing.assert_array_equal(here.certified_replaced, there.certified_replaced)
    np.testing.assert_array_equal(here.trajectory.action, there.trajectory.action)
    np.testing.assert_array_equal(here.returns, there.returns)


def test_evaluate_says_in_one_line_that_there_is_no_service(tiny_bundle: Path) -> None:
    result = command("evaluation.evaluate", tiny_bundle, "--url", "http://127.0.0.1:1")
    assert (result.returncode, result.stdout.strip()) == (2, "")
    (line,) = result.stderr.strip().splitlines()
    assert "http://127.0.0.1:1" in line


def test_what_the_service_has_not_is_refused(tiny_bundle: Path, monkeypatch) -> None:
    # A key of the user's own services is none of this one's.
    monkeypatch.setenv("LAGNET_API_KEY", "sesame")
    with Service.start(tiny_bundle, "off") as service:
        for wrong, named in (
            (("--gate", "always"), "gate off"),
            (("--threshold", "0.1"), "threshold 0.5"),
            (("--guide", "off"), "guide ahead"),
        ):
            result = command("evaluation.evaluate", tiny_bundle, "--url", service.url, *wrong)
            assert result.returncode == 2
            assert named in result.stderr


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_an_evaluation_whose_service_dies_ends_with_status_1(
    tiny_bundle: Path, tmp_path: Path, monkeypatch, capsys, number: signal.Signals
) -> None:
    """Half-way: nothing is printed and nothing written but the one line that says so."""
    figures, steps = tmp_path / "figures.json", []
    with Service.start(tiny_bundle, "risk") as service:

        def dying(*arguments, progress, **named):
            def note(count: int) -> None:
                steps.append(count)
                if len(steps) == 100:
                    os.kill(service.process.pid, number)

            return run_episodes(*arguments, progress=note, **named)

        monkeypatch.setattr(evaluate, "run_episodes", dying)
        typed = [tiny_bundle, "--url", service.url, "--episodes", 2, "--timeout", 0.2, "--json", figures]
        monkeypatch.setattr(sys, "argv", ["lagnet-evaluate", *map(str, typed)])
        with pytest.raises(SystemExit) as ended:
            evaluate.main()
        os.kill(service.process.pid, signal.SIGCONT)
    assert ended.value.code == 1
    # SIGTERM lets a service finish what is in flight, and a few steps more.
    assert 100 <= len(steps) < 900
    out, err = capsys.readouterr()
    (line,) = err.strip().splitlines()
    assert "while robots were driving" in line
    assert out.strip() == ""
    assert not figures.exists()


@pytest.mark.long
def test_the_demo_drives_through_services_that_it_stops(tiny_bundle: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    result = command("evaluation.demo", tiny_bundle, "--out", out, "--episodes", 1)
    assert result.returncode == 0, result.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert {gate: round(one["shares"]["opened_by"]["always"]) for gate, one in summary.items()} == {
        "off": 0,
        "risk": 0,
        "always": 1,
    }
    with Image.open(out / "episode.png") as picture:
        assert min(picture.size) > 800
    if browser() is None:
        assert NONE_HERE in " ".join(result.stdout.split())
    elif (out / "live.png").exists():
        with Image.open(out / "live.png") as picture:
            assert picture.size == (WIDTH, HEIGHT)
    else:  # a short drive may be over before a browser has started
        assert TOO_SHORT in " ".join(result.stdout.split())
    assert "to see it live: lagnet-serve" in result.stdout
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


STARTS_A_SERVICE = """
import sys, time
from pathlib import Path
from evaluation.camera import HEIGHT, NONE_HERE, TOO_SHORT, WIDTH, browser
from evaluation.service import Service
service = Service.start(Path(sys.argv[1]), "off")
print("started", flush=True)
time.sleep(60.0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel does it")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_whoever_is_killed_leaves_no_service_behind(own_bundle: Path, number: signal.Signals) -> None:
    owner = subprocess.Popen(
        [sys.executable, "-c", STARTS_A_SERVICE, str(own_bundle)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert owner.stdout.readline() == "started\n"
        assert len(services_of(own_bundle)) == 1
        owner.send_signal(number)
        owner.wait(10.0)
        deadline = time.monotonic() + 10.0
        while services_of(own_bundle):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        owner.kill()
        owner.wait()
        for left in services_of(own_bundle):
            os.kill(left, signal.SIGKILL)


def test_a_service_that_does_not_start_tells_why(own_bundle: Path) -> None:
    (own_bundle / "policy.onnx").unlink()
    with pytest.raises(ServiceError, match=r"policy\.onnx"):
        Service.start(own_bundle, "off")
