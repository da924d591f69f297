"""`lagnet-serve --record`: real services, killed, on a full disk, and their recordings decided again."""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from evaluation.service import Service
from pointgoal.lidar import encode
from recorder import RecordingError
from recorder.reading import Reader, Recorded
from server import Client, Fleet
from server.serve import ServeConfig, ServeError, serve

COMMAND = [sys.executable, "-m", "server.serve"]


def start(bundle: Path, *options: object, before: tuple[str, ...] = (), gate: str = "always") -> Service:
    return Service.run([*before, *COMMAND, str(bundle), "--port", "0", "--gate", gate, *map(str, options)])


def read(path: Path) -> tuple[Reader, list[Recorded]]:
    with Reader(path) as reader:
        return reader, list(reader.exchanges())


def eventually(condition: Callable[[], Any], seconds: float = 20.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def health(url: str) -> dict[str, Any]:
    link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10.0)
    link.request("GET", "/healthz")
    reply = link.getresponse()
    assert reply.status == 200
    told = json.loads(reply.read())
    link.close()
    assert told["status"] == "alive"
    return told["recording"]


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def of_kind(folder: Path, kind: str) -> list[Path]:
    return sorted(folder.glob(f"{kind}-*.mcap"))


class Robot:
    """Drives about by numbers, and remembers what it asked and was told."""

    def __init__(self, url: str) -> None:
        self.link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10.0)
        self.rng = np.random.default_rng(3)
        self.told: list[tuple[float, bytes, bytes]] = []
        self.memory: object = None

    def observe(self) -> list[float]:
        made = self.rng.uniform(0.0, 0.5, 60)
        made[28:44] = encode(self.rng.uniform(0.4, 1.5, (1, 3, 2)))[0]
        return made.tolist()

    def ask(self, **more: object) -> dict[str, Any]:
        body = {"observation": self.observe(), "memory": self.memory, "request": len(self.told)} | more
        content = json.dumps(body).encode()
        self.link.request("POST", "/act", content)
        reply = self.link.getresponse()
        answer = reply.read()
        assert reply.status == 200, answer
        self.told.append((time.monotonic(), content, answer))
        decision = json.loads(answer)
        self.memory = decision["memory"]
        return decision

    def fall_back(self) -> dict[str, Any]:
        """Too fast, and right in front of a hazard."""
        observation = self.observe()
        observation[3:5] = [1.2, 0.0]
        return self.ask(observation=observation, hazards=[[0.22, 0.0]])


def replay(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "server.replay", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("everyone", [False, True], ids=["the service", "the recorder as well"])
def test_kill_9_loses_at_most_the_last_second(tiny_bundle: Path, tmp_path: Path, everyone: bool) -> None:
    with start(tiny_bundle, "--record", tmp_path / "tapes") as service:
        robot = Robot(service.url)
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            robot.ask()
            time.sleep(0.04)  # slowly: what is much is written before its time
        writers = children(service.process.pid)
        assert len(writers) == 1
        killed = time.monotonic()
        for pid in [service.process.pid, *(writers if everyone else [])]:
            os.kill(pid, signal.SIGKILL)
        service.process.wait()
        eventually(lambda: not Path(f"/proc/{writers[0]}").exists() or "Z (zombie)" in state(writers[0]))
    [path] = of_kind(tmp_path / "tapes", "recording")
    reader, recorded = read(path)
    count = len(recorded)
    assert reader.ended is not everyone
    assert [(one.request, one.reply) for one in recorded] == [told[1:] for told in robot.told[:count]]
    assert all(at > killed - 1.0 for at, *_ in robot.told[count:])
    if not everyone:
        # The recorder goes on for as long as it takes, and says what it saw.
        [incident] = of_kind(tmp_path / "tapes", "incident")
        reader, before = read(incident)
        assert "without a word" in reader.incident["reason"]
        assert len(before) == count
    result = replay(path, "--bundle", tiny_bundle)
    assert result.returncode == 0, result.stderr
    assert f"{count} of {count} decisions equal bit for bit" in result.stdout
    assert ("breaks off" in result.stdout) is everyone
    assert path.with_suffix(".png").stat().st_size > 10_000


def state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return "Z (zombie)"


def test_after_an_orderly_stop_all_is_there_and_no_incident(tiny_bundle: Path, tmp_path: Path) -> None:
    folder = tmp_path / "made" / "on the way"
    with start(tiny_bundle, "--record", folder) as service:
        robot = Robot(service.url)
        for _ in range(50):
            robot.ask()
        link = robot.link
        link.request("POST", "/act", b'{"observation": [1.0]}')
        refused = link.getresponse()
        assert (refused.status, bool(refused.read())) == (422, True)
        assert service.stop() == 0
        assert service.complaints() == ""
    [path] = folder.iterdir()
    reader, recorded = read(path)
    assert reader.ended
    assert [(one.request, one.reply) for one in recorded] == [told[1:] for told in robot.told]
    assert path.name.startswith("recording-")


def test_a_batch_is_recorded_and_decided_again_as_a_batch(tiny_bundle: Path, tmp_path: Path) -> None:
    with start(tiny_bundle, "--record", tmp_path, gate="risk") as service:
        maker = Robot(service.url)
        with Fleet(service.url, timeout=5.0) as fleet:
            memory = None
            for _ in range(20):
                decisions = fleet.decide_batch(np.array([maker.observe() for _ in range(5)]), memory=memory)
                assert decisions.reason == [None] * 5
                memory = decisions.memory
        # One whose robots are in part none.
        body = {
            "robots": [{"observation": maker.observe()}, {"nothing": 1}, {"observation": maker.observe()}]
        }
        maker.link.request("POST", "/act/batch", json.dumps(body).encode())
        assert maker.link.getresponse().status == 200
    [path] = of_kind(tmp_path, "recording")
    _, recorded = read(path)
    assert sum(len(one.decisions) for one in recorded) == 102
    result = replay(path, "--bundle", tiny_bundle)
    assert result.returncode == 0, result.stdout
    assert "102 of 102 decisions equal bit for bit" in result.stdout


def test_a_fallback_writes_the_last_half_minute_without_record_too(tiny_bundle: Path, tmp_path: Path) -> None:
    with start(tiny_bundle, "--incidents", tmp_path) as service:
        robot = Robot(service.url)
        for _ in range(40):
            assert robot.ask()["mode"] != "fallback"
        assert not list(tmp_path.iterdir())
        decision = robot.fall_back()
        assert decision["mode"] == "fallback"
        # While the service runs: at once.
        [path] = eventually(lambda: of_kind(tmp_path, "incident"))
        eventually(lambda: health(service.url)["incidents"] == 1)
        assert health(service.url)["last_incident"] == path.name
        robot.fall_back()
        for _ in range(10):
            robot.ask()
    assert list(tmp_path.iterdir()) == [path]
    reader, recorded = read(path)
    assert reader.ended
    assert decision["reason"] in reader.incident["reason"]
    assert [(one.request, one.reply) for one in recorded] == [told[1:] for told in robot.told]
    result = replay(path, "--bundle", tiny_bundle)
    assert "52 of 52 decisions equal bit for bit" in result.stdout
    assert decision["reason"] in result.stdout


def test_a_full_disk_stops_the_recording_with_an_alarm_and_never_the_service(
    tiny_bundle: Path, tmp_path: Path
) -> None:
    """The system's own limit on a file's size stands for the disk's end."""
    limit = ("bash", "-c", 'ulimit -f 100 && exec "$@"', "bash")
    with start(tiny_bundle, "--record", tmp_path, before=limit) as service:
        robot = Robot(service.url)
        assert health(service.url)["alarm"] is None
        deadline = time.monotonic() + 30.0
        while health(service.url)["alarm"] is None:
            assert time.monotonic() < deadline
            for _ in range(10):
                robot.ask()
            time.sleep(0.1)
        told = health(service.url)
        assert told["alarm"].startswith("recording stopped: ")
        assert str(tmp_path) not in told["alarm"]
        for _ in range(100):
            assert robot.ask()["mode"] != "fallback"
        assert health(service.url) | {"waiting": 0} == told | {"waiting": 0}
        link = http.client.HTTPConnection(urlsplit(service.url).netloc)
        link.request("GET", "/readyz")
        assert link.getresponse().status == 200
        assert service.stop() == 0
        line, *alarms = service.complaints().splitlines()
        assert all("alarm='recorder'" in alarm for alarm in alarms)
        assert line == f"{told['alarm']}; the service goes on"
    [path] = of_kind(tmp_path, "recording")
    assert path.stat().st_size == 100 * 1024
    reader, recorded = read(path)
    assert not reader.ended
    assert 20 < len(recorded) < len(robot.told)
    assert [one.reply for one in recorded] == [reply for *_, reply in robot.told[: len(recorded)]]
    assert 0 < told["recorded"] <= len(recorded)  # what was being written may be there all the same


def test_a_recorder_that_is_gone_stops_the_recording_and_never_the_service(
    tiny_bundle: Path, tmp_path: Path
) -> None:
    with start(tiny_bundle, "--record", tmp_path) as service:
        robot = Robot(service.url)
        robot.ask()
        [writer] = children(service.process.pid)
        os.kill(writer, signal.SIGKILL)
        assert eventually(lambda: health(service.url)["alarm"]) == "recorder stopped: its process ended"
        for _ in range(100):
            robot.ask()
        assert service.stop() == 0
        line, *alarms = service.complaints().splitlines()
        assert all("alarm='recorder'" in alarm for alarm in alarms)
        assert "the service goes on" in line


def test_a_recorder_that_is_held_up_holds_nothing_up(tiny_bundle: Path, tmp_path: Path) -> None:
    """Stopped, as by a disk that does not answer: the decisions wait for their recording, not the robots."""
    with start(tiny_bundle, "--record", tmp_path) as service:
        robot = Robot(service.url)
        [writer] = children(service.process.pid)
        os.kill(writer, signal.SIGSTOP)
        try:
            for _ in range(300):
                robot.ask()
        finally:
            os.kill(writer, signal.SIGCONT)
        assert service.stop() == 0
    [path] = of_kind(tmp_path, "recording")
    assert [one.reply for one in read(path)[1]] == [reply for *_, reply in robot.told]


def test_ctrl_c_in_the_terminal_ends_the_recording_in_order(tiny_bundle: Path, tmp_path: Path) -> None:
    """The terminal sends it to the recorder as well."""
    service = start(tiny_bundle, "--record", tmp_path)
    with service:
        robot = Robot(service.url)
        for _ in range(30):
            robot.ask()
        os.killpg(service.process.pid, signal.SIGINT)
        assert service.process.wait(20.0) == 0
        assert service.complaints() == ""
    [path] = tmp_path.iterdir()
    reader, recorded = read(path)
    assert (reader.ended, len(recorded)) == (True, 30)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"record_file_mb": 1.0}, "--record-file-mb must be finite and at least 4"),
        ({"record_file_mb": float("nan")}, "--record-file-mb"),
        ({"record_mb": 100.0}, "--record-mb must be finite and at least 128"),
        ({"record_mb": float("inf")}, "--record-mb"),
        ({"incidents_mb": -1.0}, "--incidents-mb must be finite and at least 16"),
        ({"record": Path(__file__)}, "--record .* is a file"),
        ({"record": Path(__file__) / "below"}, "--record .* is not a folder"),
        ({"incidents": Path(__file__)}, "--incidents .* is a file"),
    ],
)
def test_a_recording_that_cannot_be_made_is_refused_before_anything_is_loaded(changes, named) -> None:
    with pytest.raises(ServeError, match=named):
        serve(ServeConfig(Path("/no bundle"), **changes))


def test_a_folder_that_cannot_be_made_after_all_is_said_in_one_line(tiny_bundle: Path) -> None:
    with pytest.raises(RecordingError, match="/proc/none: "):
        serve(ServeConfig(tiny_bundle, port=0, record=Path("/proc/none")))


def test_without_recording_there_is_no_recorder(tiny_bundle: Path) -> None:
    with start(tiny_bundle) as service:
        assert children(service.process.pid) == []
        with Client(service.url, timeout=5.0) as client:
            client.model()
        link = http.client.HTTPConnection(urlsplit(service.url).netloc)
        link.request("GET", "/healthz")
        assert json.loads(link.getresponse().read()) == {"status": "alive", "state": "ready"}
