"""Another bundle takes over while robots are driven: on real services, by signal and by request."""

from __future__ import annotations

import asyncio
import http.client
import json
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import onnx
import pytest

from evaluation.service import Service
from models import Bundle, write_bundle
from monitor import Monitor
from recorder import RecordingError
from recorder.reading import Reader
from server.change import BusyError, Changer
from server.operation import Operation

COMMAND = [sys.executable, "-m", "server.serve"]
ADMIN = {"x-api-key": "master", "content-type": "application/json"}


def ask(url: str, method: str, path: str, body: object = None) -> tuple[int, Any]:
    link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30.0)
    link.request(method, path, None if body is None else json.dumps(body), ADMIN)
    reply = link.getresponse()
    return reply.status, json.loads(reply.read())


def eventually(condition: Callable[[], Any], seconds: float = 30.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


def variant(source: Path, path: Path, name: str, **changes: object) -> str:
    """Writes a bundle like another one under a new name; its id."""
    bundle = Bundle.load(source)
    manifest = bundle.manifest.model_copy(update={"name": name} | changes)
    written: Bundle = write_bundle(path, bundle.policy, bundle.multiplier, manifest)
    return written.id


class Robot(threading.Thread):
    """Asks again and again, with the memory that it was given, until it is told to stop."""

    def __init__(self, url: str, observation: list[float]) -> None:
        super().__init__(daemon=True)
        self.replies: list[dict[str, Any]] = []
        self.statuses: set[int] = set()
        self.gone = threading.Event()
        self._link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30.0)
        self._observation = observation

    def run(self) -> None:
        memory = None
        while not self.gone.is_set():
            self._link.request(
                "POST", "/act", json.dumps({"observation": self._observation, "memory": memory}), ADMIN
            )
            reply = self._link.getresponse()
            self.statuses.add(reply.status)
            told = json.loads(reply.read())
            memory = told["memory"]
            self.replies.append(told)

    def models(self) -> list[str]:
        """The models that answered, in order, each once for as long as it did."""
        told = [reply["model"] for reply in self.replies]
        return [model for k, model in enumerate(told) if k == 0 or told[k - 1] != model]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, tiny_bundle: Path) -> Path:
    """Bundles: good ones, and such as must be refused."""
    made = tmp_path_factory.mktemp("choice")
    for name in ("second", "third"):
        variant(tiny_bundle, made / "good" / name, name)
    variant(tiny_bundle, made / "bounds", "bounds", action_high=(2.0, 1.0))
    variant(tiny_bundle, made / "radius", "radius", hazard_radius=0.3)
    shutil.copytree(tiny_bundle, made / "damaged")
    (made / "damaged" / "policy.onnx").write_bytes(b"nothing")
    broken = onnx.load_from_string(Bundle.load(tiny_bundle).policy)
    broken.graph.initializer[0].raw_data = np.full((2, 60), np.nan, np.float32).tobytes()
    nan = Bundle.load(tiny_bundle)
    write_bundle(made / "nan", broken.SerializeToString(), nan.multiplier, nan.manifest)
    (made / "outside").symlink_to(tiny_bundle)
    (made / "loop").symlink_to(made / "loop")
    (made / "file").write_text("")
    return made


@pytest.fixture(scope="module")
def service(folder: Path, tiny_bundle: Path, tmp_path_factory) -> Iterator[tuple[Service, Path, Path]]:
    """A service that records, with a link to its bundle, in a folder of its own."""
    own = tmp_path_factory.mktemp("own")
    link, tapes = own / "current", own / "tapes"
    link.symlink_to(tiny_bundle)
    key = own / "key"
    key.write_text("master")
    options = ["--port", "0", "--bundles", str(folder), "--record", str(tapes), "--log", "json"]
    with Service.run([*COMMAND, str(link), *options, "--admin-key-file", str(key)]) as running:
        yield running, link, tapes


def events(service: Service) -> list[dict[str, Any]]:
    return [json.loads(line) for line in service.complaints().splitlines()]


def test_bundles_change_while_a_robot_drives_and_nothing_is_lost(
    service, folder: Path, tiny_bundle: Path, observation
) -> None:
    running, link, tapes = service
    first, second, third = (
        Bundle.load(path).id for path in (tiny_bundle, folder / "good" / "second", folder / "good" / "third")
    )
    robot = Robot(running.url, observation)
    robot.start()
    eventually(lambda: len(robot.replies) > 30)
    status, told = ask(running.url, "POST", "/model", {"bundle": "good/second"})
    assert (status, told["model"]) == (200, second)
    assert ask(running.url, "GET", "/model")[1] == told
    eventually(lambda: robot.replies[-1]["model"] == second)
    # The signal loads what the service's own path points to now.
    link.unlink()
    link.symlink_to(folder / "good" / "third")
    running.process.send_signal(signal.SIGHUP)
    eventually(lambda: robot.replies[-1]["model"] == third)
    # A hold outlives a change.
    assert ask(running.url, "POST", "/hold", {"why": "a test"})[0] == 200
    assert ask(running.url, "POST", "/model", {"bundle": "good/second"})[1]["model"] == second
    eventually(lambda: robot.replies[-1]["model"] == second)
    assert robot.replies[-1]["reason"] == "not decided: hold: a test"
    assert ask(running.url, "POST", "/resume")[1]["state"] == "ready"
    seen = len(robot.replies)
    eventually(lambda: len(robot.replies) > seen + 30)
    assert robot.replies[-1]["reason"] != "not decided: hold: a test"
    robot.gone.set()
    robot.join(10.0)
    assert robot.statuses == {200}
    assert robot.models() == [first, second, third, second]
    link.unlink()
    link.symlink_to(tiny_bundle)
    told = [(event["before"], event["model"]) for event in events(running) if event["event"] == "bundle"]
    assert told == [(first, second), (second, third), (third, second)]
    # What was recorded is all there, and each file says truly what decided.
    recorded: list[str] = []

    def all_recorded() -> bool:
        recorded.clear()
        for path in sorted(tapes.glob("recording-*.mcap")):
            try:
                reader = Reader(path)
            except RecordingError:  # its beginning is still to be written
                return False
            with reader:
                for exchange in reader.exchanges():
                    model = json.loads(exchange.reply)["model"]
                    assert reader.model["model"] == model, path
                    recorded.append(model)
        return len(recorded) >= len(robot.replies)

    eventually(all_recorded)
    assert recorded == [reply["model"] for reply in robot.replies]
    incidents = sorted(tapes.glob("incident-*.mcap"))
    assert incidents
    for path in incidents:
        with Reader(path) as reader:
            assert {json.loads(one.reply)["model"] for one in reader.exchanges()} <= {reader.model["model"]}


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("bounds", "action_high"),
        ("radius", "hazard_radius"),
        ("damaged", "policy.onnx"),
        ("nan", "cannot decide"),
        ("nothing", "no such folder"),
        ("file", "no such folder"),
        ("good", "no such bundle|manifest.json"),
        ("outside", "no such folder"),
        ("loop", "no such folder"),
        ("../choice/good/second/../../outside", "no such folder"),
        ("..", "no such folder"),
        (".", "no such folder"),
        ("/", "no such folder"),
        ("a\x00b", "no such folder"),
        ("x" * 201, "200 characters"),
    ],
)
def test_what_does_not_fit_is_refused_and_the_old_one_serves_on(
    service, observation, name: str, why: str
) -> None:
    running, _, _ = service
    before = ask(running.url, "GET", "/model")
    status, told = ask(running.url, "POST", "/model", {"bundle": name})
    assert status == 422
    assert told["detail"][0]["loc"][:2] == ["body", "bundle"]
    assert re.search(why, told["detail"][0]["msg"]), told
    assert ask(running.url, "GET", "/model") == before
    assert ask(running.url, "POST", "/act", {"observation": observation})[1]["model"] == before[1]["model"]


def test_a_signal_for_a_bad_bundle_is_told_and_the_old_one_serves_on(
    service, folder: Path, tiny_bundle: Path
) -> None:
    running, link, _ = service
    before = ask(running.url, "GET", "/model")
    refused = len([event for event in events(running) if event["event"] == "bundle refused"])
    link.unlink()
    link.symlink_to(folder / "bounds")
    running.process.send_signal(signal.SIGHUP)
    told = eventually(
        lambda: (
            [event for event in events(running) if event["event"] == "bundle refused"][refused:]
            or [event for event in events(running) if event.get("left_out")]
        )
    )
    assert told
    assert ask(running.url, "GET", "/model") == before
    link.unlink()
    link.symlink_to(tiny_bundle)


def test_one_at_a_time_and_whatever_fails_changes_nothing(monitor: Monitor, tiny_bundle: Path) -> None:
    operation = Operation(monitor)
    begun, go_on = threading.Event(), threading.Event()

    def load(path: Path) -> Monitor:
        begun.set()
        assert go_on.wait(10.0)
        raise RuntimeError("a programming error")

    changer = Changer(operation, load, tiny_bundle)

    async def both() -> None:
        first = asyncio.create_task(changer.again())
        await asyncio.get_running_loop().run_in_executor(None, begun.wait, 10.0)
        with pytest.raises(BusyError):
            await changer.again()
        go_on.set()
        with pytest.raises(ValueError, match=r"cannot be loaded \(RuntimeError\)"):
            await first

    interval = sys.getswitchinterval()
    asyncio.run(both())
    assert operation.duty.now.monitor is monitor
    assert sys.getswitchinterval() == interval
