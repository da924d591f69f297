"""`lagnet-replay` as it is typed: the timeline, the picture, and the decisions made again."""

from __future__ import annotations

import json
import re
import shutil
import struct
import sys
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from fastapi.testclient import TestClient

from filter import FilterConfig
from monitor import Monitor
from recorder import Recorder, Settings
from recorder.channels import Scribe
from recorder.exchange import Exchange
from recorder.reading import Reader
from recorder.tape import Tape
from server.app import create_app
from server.replay import main
from server.schema import ModelReply

STEPS = 60
SIGNATURE = b"\x89PNG\r\n\x1a\n"


class Result(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def replay(monkeypatch, capsys) -> Callable[..., Result]:
    """The command, in this process; `test_record.py` runs it as one of its own."""

    def run(*words: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["lagnet-replay", *map(str, words)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        return Result(status, *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, drive, monitor: Monitor) -> Path:
    """Two robots in the simulation, each asked about alone, and both in a batch; then a fallback."""
    folder = tmp_path_factory.mktemp("tapes")
    wanted = Settings(str(folder), 10**9, 10**8, str(folder), 10**9)
    with Recorder(wanted, ModelReply.of(monitor).model_dump(), {}) as recorder:
        links = [
            TestClient(create_app(monitor, recorder=recorder), client=(f"robot{k}", 1)) for k in range(3)
        ]
        memory: list[Any] = [None] * 4
        for moment in drive(STEPS, n=2):
            if moment.step == STEPS:
                break
            actions = []
            for k in range(2):
                body = {"observation": moment.observation[k].tolist(), "memory": memory[k]}
                reply = links[k].post("/act", json=body).json()
                actions.append(reply["action"])
                memory[k] = reply["memory"]
            robots = [
                {"observation": moment.observation[k].tolist(), "memory": memory[2 + k]} for k in range(2)
            ]
            replies = links[2].post("/act/batch", json={"robots": robots}).json()["replies"]
            memory[2:] = [reply["memory"] for reply in replies]
            moment.action = np.array(actions)
        last = moment.observation[1].copy()
        last[3:5] = [1.2, 0.0]
        reply = links[1].post("/act", json={"observation": last.tolist(), "hazards": [[0.22, 0.0]]}).json()
        assert reply["mode"] == "fallback"
    [path] = folder.glob("recording-*.mcap")
    assert len(list(folder.glob("incident-*.mcap"))) == 1
    return path


@pytest.fixture
def own(recorded: Path, tmp_path: Path) -> Path:
    """The recording, to be damaged."""
    return Path(shutil.copy(recorded, tmp_path / "own.mcap"))


def rows(output: str) -> list[list[str]]:
    """The table's lines, as words; without those that go on from the line above."""
    return [line.split() for line in output.splitlines() if re.match(r" *-?\d+\.\d{3} +\d+ ", line)]


def test_the_same_bundle_decides_the_same_bit_for_bit(replay, own: Path, tiny_bundle: Path) -> None:
    result = replay(own, "--bundle", tiny_bundle, "--all")
    assert (result.returncode, result.stderr) == (0, "")
    count = 4 * STEPS + 1
    assert f"{count} of {count} decisions equal bit for bit" in result.stdout
    shown = rows(result.stdout)
    assert len(shown) == count
    assert {line[1] for line in shown} == {"1", "2", "3", "4"}
    # They are no empty decisions: somebody stood in the way.
    assert {"nominal", "filtered", "guided"} & {line[3] for line in shown}
    assert own.with_suffix(".png").read_bytes().startswith(SIGNATURE)


def test_the_timeline_has_the_changes_and_what_followed_them(replay, own: Path) -> None:
    result = replay(own)
    assert result.returncode == 0
    shown = rows(result.stdout)
    assert sum(int(line[2]) for line in shown) == 4 * STEPS + 1
    assert len(shown) < 2 * STEPS
    for robot in "1234":
        kinds = [line[3:6] for line in shown if line[1] == robot]
        assert all(one != two for one, two in pairwise(kinds))
    assert "too fast to stay clear" in " ".join(result.stdout.split())
    assert "least harm" in result.stdout
    assert "robot 2: " in result.stdout  # whom the picture shows
    assert "equal" not in result.stdout


def test_one_robot_alone(replay, own: Path, tiny_bundle: Path, tmp_path: Path) -> None:
    picture = tmp_path / "one.png"
    result = replay(own, "--robot", 4, "--bundle", tiny_bundle, "--out", picture)
    assert f"{STEPS} of {STEPS} decisions equal bit for bit" in result.stdout
    assert {line[1] for line in rows(result.stdout)} == {"4"}
    assert picture.read_bytes().startswith(SIGNATURE)
    assert not own.with_suffix(".png").exists()
    result = replay(own, "--robot", 9)
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert "no decision about robot 9" in result.stderr


def test_an_incident_is_told_from_its_cause_on(
    replay, recorded: Path, tiny_bundle: Path, tmp_path: Path
) -> None:
    [incident] = recorded.parent.glob("incident-*.mcap")
    own = shutil.copy(incident, tmp_path)
    result = replay(own, "--bundle", tiny_bundle)
    assert result.returncode == 0
    assert "incident at " in result.stdout
    assert "which is 0 s: robot 2: too fast" in result.stdout
    shown = rows(result.stdout)
    assert float(shown[0][0]) < 0.0
    assert shown[-1][0] == "0.000"
    assert shown[-1][3] == "fallback"


def test_another_bundle_decides_otherwise_and_it_is_said_where(
    replay, own: Path, make_bundle_of, tmp_path: Path
) -> None:
    other = make_bundle_of(tmp_path / "other", multiplier_tail=["Neg", "Abs", "Sqrt"])
    result = replay(own, "--bundle", other)
    assert result.returncode == 1
    assert "another bundle" in result.stdout
    count = 4 * STEPS + 1
    assert f"{count} of {count} decisions differ" in result.stdout
    assert re.search(r"  0\.000 s, robot 1: risk was \d\.\d+, is \d\.\d+\n", result.stdout)
    assert "action was" not in result.stdout


def write_again(
    recorded: Path, path: Path, change: Callable[[int, bytes], bytes] = lambda _, reply: reply
) -> None:
    """The same recording, in chunks of ten exchanges, with some replies changed by their place."""
    with Reader(recorded) as reader:
        model = reader.model
        exchanges = list(reader.exchanges())
    text = {"version": "0", "model": json.dumps(model), "filter": "{}"}
    about = {"version": "0", "text": text, "layout": model["observation_layout"]}
    tape, scribe = Tape(path, about), Scribe(about["layout"])
    for place, one in enumerate(exchanges):
        reply = change(place, one.reply)
        exchange = Exchange(one.number, one.received, one.sent, ("a", 1), 200, one.request, reply)
        tape.add(exchange, scribe.entries(exchange)[0])
        if place % 10 == 9:
            tape.flush()
    tape.close()


@pytest.mark.parametrize("field", ["action", "risk"])
def test_the_last_bit_of_a_number_is_a_difference(
    replay, recorded: Path, tiny_bundle: Path, tmp_path: Path, field: str
) -> None:
    """The same recording but for one bit of one decision."""

    def change(place: int, reply: bytes) -> bytes:
        if place != 10:
            return reply
        told = json.loads(reply)
        told = told["replies"][0] if "replies" in told else told
        number = told[field] if field == "risk" else told[field][1]
        bits = struct.unpack("<q", struct.pack("<d", number))[0]
        other = struct.unpack("<d", struct.pack("<q", bits + 1))[0]
        changed = reply.replace(repr(number).encode(), repr(other).encode(), 1)
        assert changed != reply
        return changed

    write_again(recorded, tmp_path / "a.mcap", change)
    result = replay(tmp_path / "a.mcap", "--bundle", tiny_bundle)
    assert result.returncode == 1
    assert f"1 of {4 * STEPS + 1} decisions differ" in result.stdout
    assert f"{field} was " in result.stdout
    assert "another bundle" not in result.stdout


def test_a_file_that_breaks_off_is_replayed_up_to_there(
    replay, recorded: Path, tiny_bundle: Path, tmp_path: Path
) -> None:
    torn = tmp_path / "torn.mcap"
    write_again(recorded, torn)
    data = torn.read_bytes()
    torn.write_bytes(data[: data.rindex(b"\x28\xb5\x2f\xfd") + 50])  # in the middle of the last chunk
    with Reader(torn) as reader:
        kept = sum(len(one.decisions) for one in reader.exchanges())
    assert 4 * STEPS - 20 <= kept < 4 * STEPS + 1
    result = replay(torn, "--bundle", tiny_bundle)
    assert result.returncode == 0
    assert "breaks off" in result.stdout
    assert f"{kept} of {kept} decisions equal bit for bit" in result.stdout


@pytest.mark.parametrize("content", [b"", b"no recording", bytes(500)])
def test_what_is_no_recording_is_said_in_one_line(replay, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    result = replay(tmp_path / "a.mcap")
    assert (result.returncode, result.stdout) == (2, "")
    [line] = result.stderr.splitlines()
    assert line.endswith("a.mcap: no recording of lagnet-serve")


def test_what_cannot_be_read_or_written_is_said_in_one_line(replay, own: Path, tiny_bundle: Path) -> None:
    for words, named in (
        ([own.parent / "none.mcap"], "none.mcap: No such file"),
        ([own.parent], "Is a directory"),
        ([own, "--out", own.parent / "none" / "a.png"], "there is no folder"),
        ([own, "--bundle", own.parent / "none"], "no such bundle"),
    ):
        result = replay(*words)
        assert (result.returncode, result.stdout) == (2, ""), words
        [line] = result.stderr.splitlines()
        assert named in line


def test_a_fault_is_recorded_and_is_an_incident(
    replay, tmp_path: Path, tiny_bundle: Path, observation
) -> None:
    """A decision that could not be told: the robot had status 500, and played its plan."""
    broken = Monitor.load(tiny_bundle, "always")
    wanted = Settings(str(tmp_path), 10**9, 10**8, str(tmp_path), 10**9)
    with Recorder(wanted, ModelReply.of(broken).model_dump(), {}) as recorder:
        app = TestClient(create_app(broken, recorder=recorder))
        memory = app.post("/act", json={"observation": observation}).json()["memory"]
        body = {"observation": observation, "memory": memory}
        assert app.post("/act", json=body).status_code == 200
        broken.decide = lambda *_: 1 / 0
        assert app.post("/act", json=body).status_code == 500
    [incident] = tmp_path.glob("incident-*.mcap")
    with Reader(incident) as reader:
        assert "500" in reader.incident["reason"]
    result = replay(incident)
    assert result.returncode == 0
    assert rows(result.stdout)[-1][3] == "fault"
    # Decided again, it is not as it was.
    result = replay(incident, "--bundle", tiny_bundle)
    assert result.returncode == 1
    assert "1 of 3 decisions differ" in result.stdout


def test_the_filters_settings_are_those_of_then(
    replay, tmp_path: Path, tiny_bundle: Path, observation
) -> None:
    config = FilterConfig(margin=0.2, delay_steps=2)
    careful = Monitor.load(tiny_bundle, "always", filter_config=config)
    wanted = Settings(str(tmp_path), 10**9, 10**8, None, 0)
    body: dict[str, Any] = {"observation": observation, "hazards": [[0.55, 0.1]]}
    with Recorder(wanted, ModelReply.of(careful).model_dump(), asdict(config)) as recorder:
        app = TestClient(create_app(careful, recorder=recorder))
        replies = []
        for _ in range(20):
            replies.append(app.post("/act", json=body).json())
            body["memory"] = replies[-1]["memory"]
    usual = Monitor.load(tiny_bundle, "always").decide(observation, body["hazards"])
    assert replies[0]["barrier"] != usual.barrier
    result = replay(next(tmp_path.glob("*.mcap")), "--bundle", tiny_bundle)
    assert "20 of 20 decisions equal bit for bit" in result.stdout


def test_what_the_monitor_was_not_asked_is_not_compared(
    replay, tmp_path: Path, tiny_bundle: Path, monitor: Monitor, observation
) -> None:
    """A fallback for a stale observation: only the service of then knew how old it was."""
    wanted = Settings(str(tmp_path), 10**9, 10**8, None, 0)
    body = {"observation": observation, "robot": "a"}
    with Recorder(wanted, ModelReply.of(monitor).model_dump(), {}) as recorder:
        app = TestClient(create_app(monitor, recorder=recorder))
        reasons = [
            app.post("/act", json=body | {"stamp": stamp}).json()["reason"] for stamp in (2.0, 1.0, 3.0)
        ]
        robots = [body | {"stamp": 4.0}, body | {"stamp": 0.0}, {"observation": observation}]
        app.post("/act/batch", json={"robots": robots})
    assert reasons == [None, "not decided: the stamp goes back by 1 s", None]
    result = replay(next(tmp_path.glob("*.mcap")), "--bundle", tiny_bundle)
    assert result.returncode == 0
    assert "4 of 4 decisions equal bit for bit" in result.stdout
    assert "2 fallbacks are the service's own" in result.stdout


def test_an_alarm_has_the_ring_written(tmp_path: Path, monitor: Monitor, observation) -> None:
    wanted = Settings(None, 0, 0, str(tmp_path), 10**9)
    with Recorder(wanted, ModelReply.of(monitor).model_dump(), {}) as recorder:
        app = TestClient(create_app(monitor, recorder=recorder))
        for _ in range(5):
            app.post("/act", json={"observation": observation})
        recorder.incident("alarm: λ has been high for 3 s")
    [path] = tmp_path.iterdir()
    with Reader(path) as reader:
        assert reader.incident["reason"] == "alarm: λ has been high for 3 s"
        assert len(list(reader.exchanges())) == 5
