"""`lagnet-serve --workers`: several real processes behind one address, and what becomes of them."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from evaluation.closed_loop import run_episodes
from evaluation.service import Service
from server import Client, Fleet
from server.app import create_app
from server.crew import Crew, labelled
from server.keys import Keys
from server.serve import ServeConfig, ServeError, serve
from server.workers import part

COMMAND = [sys.executable, "-m", "server.serve"]
BUNDLE = Path(__file__).parents[2] / "models/pointgoal1"


def started(bundle: Path, *more: str) -> Service:
    return Service.run([*COMMAND, str(bundle), "--port", "0", "--workers", "2", *more])


def children(service: Service) -> list[int]:
    """Process ids of the workers that run."""
    pid = service.process.pid
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def get(service: Service, path: str, method: str = "GET") -> tuple[int, Any]:
    link = http.client.HTTPConnection(urlsplit(service.url).netloc, timeout=10.0)
    link.request(method, path)
    reply = link.getresponse()
    content = reply.read()
    link.close()
    return reply.status, json.loads(content)


def samples(service: Service, name: str) -> list[Any]:
    """What the metric of this name has."""
    with urlopen(f"{service.url}/metrics", timeout=10.0) as reply:
        text = reply.read().decode()
    [family] = [one for one in text_string_to_metric_families(text) if one.name == name]
    return list(family.samples)


def until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def gone(pid: int) -> bool:
    """Whether a process has ended, or waits to be buried."""
    try:
        return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return True


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    with started(BUNDLE) as running:
        yield running


def test_robots_drive_on_while_one_worker_after_the_other_is_killed(service: Service) -> None:
    before = get(service, "/healthz")[1]
    assert (before["workers"], before["ready"], before["restarts"]) == (2, [1, 2], 0)
    first, second = children(service)
    steps = 0

    def kill(_: int) -> None:
        nonlocal steps
        steps += 1
        if steps == 300:
            os.kill(first, signal.SIGKILL)
        if steps == 600:
            # Not before the first one is back: somebody has to answer.
            until(lambda: get(service, "/healthz")[1]["restarts"] == 1)
            until(lambda: get(service, "/healthz")[1]["ready"] == [1, 2])
            os.kill(second, signal.SIGKILL)

    with Fleet(service.url, timeout=1.0) as fleet:
        episodes = run_episodes("PointGoal1-v0", fleet, 2, seed=31, progress=kill)
    assert episodes.violating_steps.tolist() == [0, 0]
    # Each robot has lost at most the requests that were under way, or none; then another worker had it.
    assert len([reason for reason in episodes.reasons if reason.startswith("service")]) <= 4
    until(lambda: get(service, "/healthz")[1]["restarts"] == 2)
    until(lambda: get(service, "/healthz")[1]["ready"] == [1, 2])
    status, after = get(service, "/healthz")
    assert (status, after["restarts"], len(after["each"])) == (200, 2, 2)
    assert after["last"] == "worker 2 was killed by SIGKILL"
    assert service.complaints().count("was killed by SIGKILL and is started again") == 2
    assert not {first, second} & set(children(service))


def test_what_one_worker_alone_would_hear_is_refused(service: Service) -> None:
    for method, path in (("POST", "/alarms/risk/ack"), ("GET", "/"), ("GET", "/live")):
        status, said = get(service, path, method)
        assert status == 501
        assert said["detail"][0]["msg"].startswith(f"{method} {path} would reach one of the workers alone")
    assert get(service, "/model")[0] == 200


def test_a_robots_stream_is_one_workers(service: Service, observation: list[float]) -> None:
    """The memory comes back to the worker that gave it: none of them is older than the robot's last."""

    def distrusted() -> float:
        return sum(one.value for one in samples(service, "lagnet_faults") if one.labels["kind"] == "memory")

    before, url = distrusted(), service.url.replace("http", "ws")
    robots = [Client(url, timeout=5.0, robot=f"streamed{k}") for k in range(4)]
    memories: list[Any] = [None] * len(robots)
    for _ in range(5):
        for k, robot in enumerate(robots):
            memories[k] = robot.decide(observation, memory=memories[k]).memory
    for robot in robots:
        assert not robot.faults.counts
        robot.close()
    assert distrusted() == before


def test_a_hold_is_refused(monitor, tmp_path: Path) -> None:
    """It would hold the robots of one worker, until that one dies."""
    crew = Crew(1, [tmp_path / "1"])
    app = TestClient(create_app(monitor, keys=Keys(admin="sesame"), around=crew.around))
    for path in ("/hold", "/resume", "/model", "/robots/one/reset"):
        assert app.post(path, headers={"x-api-key": "sesame"}).status_code == 501


def test_what_is_stamped_is_not_decided_about(service: Service, observation: list[float]) -> None:
    """Each worker would learn another clock, and a hold would end with the connection."""
    body = json.dumps({"observation": observation, "robot": "one", "stamp": 1.0})
    link = http.client.HTTPConnection(urlsplit(service.url).netloc, timeout=10.0)
    link.request("POST", "/act", body)
    reply = json.loads(link.getresponse().read())
    link.close()
    assert reply["mode"] == "fallback"
    assert "several processes answer" in reply["reason"]
    status, said = get(service, "/robots")
    assert status == 200
    assert "one" not in [robot["robot"] for each in said["each"] for robot in each["robots"]]


def test_alarms_and_metrics_are_those_of_all(service: Service) -> None:
    status, said = get(service, "/alarms")
    assert (status, len(said["each"])) == (200, 2)
    first, second = ([alarm["name"] for alarm in one["list"]] for one in said["each"])
    assert "latency" in first
    assert first == second
    assert [one.labels for one in samples(service, "lagnet_threshold")] == [{"worker": "1"}, {"worker": "2"}]


def test_every_worker_gets_robots(service: Service) -> None:
    """Robots that connect at once do not all go to one worker."""
    fleet = [Client(service.url, timeout=1.0) for _ in range(32)]
    inodes = [sockets_of(pid) for pid in children(service)]
    for client in fleet:
        client.close()
    assert min(inodes) >= 1


def sockets_of(pid: int) -> int:
    """How many connections a process has accepted."""
    links = [str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()]
    own = {link.removeprefix("socket:[").removesuffix("]") for link in links if link.startswith("socket:[")}
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return sum(row[3] == "01" and row[9] in own for row in rows)


@pytest.mark.long
def test_a_worker_that_hangs_is_replaced_and_no_robot_waits_for_it(tiny_bundle: Path, observation) -> None:
    with started(tiny_bundle) as service:
        hung, _ = children(service)
        os.kill(hung, signal.SIGSTOP)
        answered: list[bool] = []
        until(lambda: answered.append(decided(service, observation)) or gone(hung))
        assert answered.count(True) >= 1
        until(lambda: get(service, "/healthz")[1]["last"] == "worker 1 was killed by SIGKILL")
        until(lambda: get(service, "/healthz")[1]["ready"] == [1, 2])
        assert "worker 1 does not answer and is killed" in service.complaints()


def decided(service: Service, observation: list[float]) -> bool:
    """Whether a robot that connects now gets its decision."""
    with Client(service.url, timeout=1.0) as client:
        return client.decide(observation).opened_by != "fault"


@pytest.mark.long
def test_a_hangup_changes_the_bundle_and_a_bad_one_is_left_aside(tiny_bundle: Path, tmp_path: Path) -> None:
    """A new worker listens before the old one goes."""
    link = tmp_path / "bundle"
    link.symlink_to(tiny_bundle)
    with started(link) as service:
        old = children(service)
        link.unlink()
        service.process.send_signal(signal.SIGHUP)
        until(lambda: "those that run stay" in service.complaints())
        assert children(service) == old
        link.symlink_to(BUNDLE)
        service.process.send_signal(signal.SIGHUP)
        until(lambda: service.complaints().count("was started anew") == 2)
        until(lambda: not set(old) & set(children(service)))
        status, said = get(service, "/model")
        assert (status, said["algorithm"]) == (200, "lagnet-foresight")
        assert get(service, "/healthz")[1]["restarts"] == 0


@pytest.mark.long
def test_a_stop_drains_every_worker_and_each_has_recorded(tiny_bundle, observation, tmp_path) -> None:
    with started(tiny_bundle, "--drain-seconds", "1.0", "--record", str(tmp_path)) as service:
        client = Client(service.url, timeout=5.0)
        pids = children(service)
        said = get(service, "/healthz")[1]
        assert [one["recording"]["alarm"] for one in said["each"]] == [None, None]
        assert {path.name for path in tmp_path.iterdir()} == {"worker-1", "worker-2"}
        service.process.send_signal(signal.SIGTERM)
        until(lambda: get(service, "/readyz")[0] == 503)
        status, said = get(service, "/readyz")
        assert (status, said["status"]) == (503, "draining")
        assert [one["status"] for one in said["each"]] == ["draining", "draining"]
        assert client.decide(observation).reason is None
        client.close()
        assert service.process.wait(15.0) == 0
        assert service.complaints() == ""
        assert all(map(gone, pids))
    assert len(list(tmp_path.glob("worker-?/recording-*.mcap"))) == 1


@pytest.mark.long
def test_workers_whose_supervisor_is_killed_stop_by_themselves(tiny_bundle: Path) -> None:
    service = started(tiny_bundle)
    pids = children(service)
    assert len(pids) == 2
    service.process.kill()
    service.process.wait()
    until(lambda: all(map(gone, pids)))


def test_what_cannot_be_served_is_one_line() -> None:
    command = [*COMMAND, "/none", "--port", "0", "--workers", "2"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert "no such bundle" in result.stderr


def test_what_several_workers_cannot_do_is_refused(tiny_bundle: Path, tmp_path: Path) -> None:
    rules = tmp_path / "alarms.toml"
    rules.write_text('[risk]\neffect = "hold"\n')
    with pytest.raises(ServeError, match="--alarms: risk would hold one process alone"):
        serve(ServeConfig(tiny_bundle, workers=2, alarms=rules))
    with pytest.raises(ServeError, match="--bundles: POST /model would change one process alone"):
        serve(ServeConfig(tiny_bundle, workers=2, bundles=tmp_path))
    with pytest.raises(ServeError, match="--max-age-ms: one process must follow a robot's clock"):
        serve(ServeConfig(tiny_bundle, workers=2, max_age_ms=100.0))
    with pytest.raises(ServeError, match="--workers must be at least 1, got 0"):
        serve(ServeConfig(tiny_bundle, workers=0))


def test_every_worker_records_in_a_folder_of_its_own(tiny_bundle: Path, tmp_path: Path) -> None:
    config = ServeConfig(tiny_bundle, workers=2, record=tmp_path, record_mb=400.0, incidents_mb=100.0)
    parts = [part(config, number) for number in (1, 2)]
    assert [one.record for one in parts] == [tmp_path / "worker-1", tmp_path / "worker-2"]
    assert sum(one.record_mb for one in parts) == config.record_mb
    assert sum(one.incidents_mb for one in parts) == config.incidents_mb


def test_room_that_is_too_small_for_all_is_refused(tiny_bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(ServeError, match="--record-mb must be finite and at least 256"):
        ServeConfig(tiny_bundle, workers=2, record=tmp_path, record_mb=200.0).check()


def answering(status: int, body: bytes) -> Any:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": status, "headers": []})
        await send({"type": "http.response.body", "body": body})

    return app


async def asked_of_all(folder: Path, path: str, *answers: tuple[int, bytes] | None) -> tuple[int, bytes]:
    """What the first of some workers says when all answer as given; one whose answer is None is not there."""
    places = [folder / f"{number}" for number in range(len(answers))]
    crews = [Crew(number + 1, places) for number in range(len(answers))]
    for crew, answer in zip(crews, answers, strict=True):
        if answer is not None:
            crew.around(answering(*answer))
            await crew.start()
    told = await crews[0].all(path)
    return told.status, told.body


@pytest.mark.parametrize(
    ("second", "status", "said"),
    [
        ((200, b'{"status":"ready"}'), 200, "ready"),
        ((503, b'{"status":"degraded"}'), 503, "degraded"),
        (None, 200, "ready"),
    ],
)
def test_the_worst_worker_says_whether_the_service_is_ready(tmp_path, second, status, said) -> None:
    got, body = asyncio.run(asked_of_all(tmp_path, "/readyz", (200, b'{"status":"ready"}'), second))
    assert (got, json.loads(body)["status"]) == (status, said)


def metrics(requests: float, label: str) -> bytes:
    registry = CollectorRegistry()
    Counter("lagnet_requests", "By path.", ["path"], registry=registry).labels(label).inc(requests)
    Gauge("lagnet_up", "One line,\nand another.", registry=registry).set(1)
    Histogram("lagnet_seconds", "How long.", buckets=(0.1, 1.0), registry=registry).observe(requests)
    return generate_latest(registry)


@given(st.lists(st.tuples(st.integers(0, 9), st.text(max_size=8)), min_size=1, max_size=3))
def test_metrics_of_all_workers_are_told_apart(samples) -> None:
    texts = {number: metrics(*sample).decode() for number, sample in enumerate(samples, 1)}
    expected = {
        (sample.name, tuple(sorted((sample.labels | {"worker": str(number)}).items())), sample.value)
        for number, text in texts.items()
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    families = list(text_string_to_metric_families(labelled(texts)))
    assert len({family.name for family in families}) == len(families)  # each stands together
    assert expected == {
        (sample.name, tuple(sorted(sample.labels.items())), sample.value)
        for family in families
        for sample in family.samples
    }


def test_metrics_tell_how_many_workers_there_are(tmp_path) -> None:
    ours = (200, metrics(3, "/act"))
    status, body = asyncio.run(asked_of_all(tmp_path, "/metrics", ours, ours))
    values = {
        sample.name: sample.value
        for family in text_string_to_metric_families(body.decode())
        for sample in family.samples
        if not sample.labels
    }
    assert status == 200
    assert values == {"lagnet_workers": 2, "lagnet_workers_ready": 0, "lagnet_worker_restarts_total": 0}
