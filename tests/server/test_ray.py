"""The service on Ray Serve: what can be deployed, and a robot that drives through a cluster of two nodes."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from fastapi.testclient import TestClient

from evaluation.closed_loop import run_episodes
from evaluation.service import Service
from models import BundleError
from server import Client, Fleet
from server.app import create_app
from server.keys import Keys
from server.ray import RayConfig, deploy
from server.ray import replica as make_replica
from server.serve import ServeError

MODELS = Path(__file__).parents[2] / "models"
COMMAND = [sys.executable, "-m", "server.ray"]


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"max_age_ms": 100.0}, "--max-age-ms is of one process"),
        ({"workers": 2}, "--workers is of one process"),
        ({"record": Path("/tmp")}, "--record is of one process"),
        ({"drain_seconds": 2.0}, "--drain-seconds is of one process"),
        ({"margin": -1.0}, "--margin"),
        ({"min_replicas": 0}, "--min-replicas must be 1 to --max-replicas"),
        ({"min_replicas": 5}, "--min-replicas must be 1 to --max-replicas, got 5 and 4"),
        ({"ongoing": 0.0}, "--ongoing"),
        ({"address": "auto"}, "--memory-key-file"),
    ],
)
def test_what_a_replica_cannot_do_is_refused(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ServeError, match=named):
        RayConfig(MODELS / "pointgoal1", **settings).check()


def test_a_replica_answers_what_the_service_does(monitor, tiny_bundle: Path, observation) -> None:
    """The bundle is that of the driver's files, whatever lies on the node."""
    files = {path.name: path.read_bytes() for path in tiny_bundle.iterdir()}
    config = RayConfig(Path("/elsewhere") / tiny_bundle.name, gate="always")
    mine, app = make_replica(files, config, Keys(act="sesame"), bytes(32))
    plain = TestClient(create_app(monitor))
    with TestClient(app) as service:  # Ray says that it begins, and that it ends
        pass
    asked = {"observation": observation}
    assert service.post("/act", json=asked).status_code == 401
    replies = [
        service.post("/act", json=asked, headers={"x-api-key": "sesame"}).json(),
        plain.post("/act", json=asked).json(),
    ]
    for reply in replies:
        reply.pop("seconds")
        reply.pop("memory")  # sealed with another key
    assert replies[0] == replies[1]
    assert mine.bundle.id == monitor.bundle.id
    key = {"x-api-key": "sesame"}
    assert service.get("/readyz").status_code == service.get("/model", headers=key).status_code == 200
    for path in ("/robots", "/live", "/"):
        refused = service.get(path, headers=key)
        assert refused.status_code == 501
        assert refused.json()["detail"][0]["msg"] == f"GET {path} would reach one of the replicas alone"
    # Another replica may have seen the robot's last stamp.
    reply = service.post("/act", json=asked | {"robot": "one", "stamp": 1.0}, headers=key).json()
    assert (reply["mode"], reply["opened_by"]) == ("fallback", "fault")
    assert "follow a robot's clock" in reply["reason"]


def test_what_cannot_be_deployed_is_one_line() -> None:
    pytest.importorskip("ray.serve")
    command = [*COMMAND, str(MODELS / "pointgoal1"), "--record", "here"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.strip() == "server.ray: --record is of one process, or Ray's to say: not with Ray"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes with room for one replica each; the head listens."""
    pytest.importorskip("ray.serve")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray
    from ray import serve
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80_000_000}
    nodes = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    try:
        second = nodes.add_node(**node)
        ray.init(nodes.address, log_to_driver=False, logging_level="ERROR")
        yield nodes, second
        serve.shutdown()
    finally:
        ray.shutdown()
        nodes.shutdown()


@pytest.mark.long
def test_a_robot_drives_on_while_the_bundle_changes_and_a_node_dies(cluster, tmp_path: Path) -> None:
    nodes, second = cluster
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    config = RayConfig(
        MODELS / "lagnet1",
        port=free_port(),
        min_replicas=2,
        max_replicas=2,
        every_node=False,
        memory_key_file=key,
    )
    url = deploy(config)["url"]
    with Client(url, timeout=5.0) as client:
        assert client.model().model.startswith("lagnet1@")
    with pytest.raises(BundleError):
        deploy(replace(config, bundle=Path("/none")))
    with Client(url, timeout=5.0) as client:
        assert client.model().model.startswith("lagnet1@")
    with asking(url) as seen:
        deploy(replace(config, bundle=MODELS / "pointgoal1"))
    # Nobody was left without an answer while one replica after the other was changed.
    assert {status for status, _ in seen} == {200}
    assert [model.partition("@")[0] for _, model in (seen[0], seen[-1])] == ["lagnet1", "pointgoal1"]
    for _ in range(8):
        with Client(url, timeout=5.0) as client:
            assert client.model().model.startswith("pointgoal1@")
    running = replicas(2)
    assert len(set(running.values())) == 2
    [doomed] = [pid for pid, node in running.items() if node == second.node_id]
    steps = 0

    def kill(_: int) -> None:
        nonlocal steps
        steps += 1
        if steps == 300:
            # All of the node at once; by itself the replica would live on for a while.
            os.kill(doomed, signal.SIGKILL)
            nodes.remove_node(second, allow_graceful=False)

    with Fleet(url, timeout=1.0) as fleet:
        episodes = run_episodes("PointGoal1-v0", fleet, 2, seed=32, progress=kill)
        # What was lost with the node was a fallback; from then on the other replica decides.
        assert fleet.decide([0.0] * 60).opened_by != "fault"
    assert episodes.violating_steps.tolist() == [0, 0]
    assert steps == 1000
    assert len(episodes.reasons) < 200
    assert set(replicas(1)) == set(running) - {doomed}


@contextmanager
def asking(url: str) -> Iterator[list[tuple[int, str]]]:
    """Asks for decisions meanwhile; statuses and models of the replies."""
    seen: list[tuple[int, str]] = []
    done = threading.Event()

    def ask() -> None:
        body = json.dumps({"observation": [0.0] * 60})
        while not done.is_set():
            link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10.0)
            link.request("POST", "/act", body, {"content-type": "application/json"})
            reply = link.getresponse()
            seen.append((reply.status, json.loads(reply.read()).get("model", "")))
            link.close()

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield seen
    finally:
        done.set()
        thread.join()


def replicas(count: int) -> dict[int, str]:
    """Process ids of the replicas that run, and their nodes, once there are so many."""
    from ray._private.state import actors

    deadline = time.monotonic() + 60.0
    while True:
        rows = [row for row in actors().values() if "Replica" in row["ActorClassName"]]
        found = {row["Pid"]: row["Address"]["NodeID"] for row in rows if row["State"] == "ALIVE"}
        if len(found) == count:
            return found
        assert time.monotonic() < deadline, rows
        time.sleep(0.2)


@pytest.mark.long
def test_without_a_cluster_it_serves_on_this_machine_until_it_is_told_to_stop(tiny_bundle: Path) -> None:
    pytest.importorskip("ray.serve")
    command = [*COMMAND, str(tiny_bundle), "--port", str(free_port()), "--gate", "always"]
    with Service.run(command) as service:
        with Client(service.url, timeout=5.0) as client:
            assert client.decide([0.0] * 60).opened_by != "fault"
        service.process.terminate()
        assert service.process.wait(30.0) == 0
