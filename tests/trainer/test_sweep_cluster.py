"""`lagnet-sweep` as typed, on real Ray: two nodes of which one is killed, and Ctrl-C on this machine."""

import csv
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from trainer import checkpoint
from trainer.sweep import Sweep
from trainer.sweep.settings import FOLDER, plan
from trainer.sweep.worker import read_holder
from trainer.train import train

pytest.importorskip("ray")
pytestmark = pytest.mark.long

TINY = {
    "task": "PointGoal0-v0", "total_steps": 20_000, "epoch_steps": 400, "num_envs": 10, "minibatch": 400,
    "passes": 1, "checkpoint_every": 2,
}  # fmt: skip
ENVIRONMENT = os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
SECONDS = 120.0


def command(out: Path, *more: str) -> list[str]:
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    line = [sys.executable, "-m", "trainer.sweep", "--algorithms", "ppo", "lagnet", "--cost-limits", "1.0"]
    return [*line, "--seeds", "0", "--out", str(out), "--no-tensorboard", *flags, *more]


def call(out: Path, *more: str) -> subprocess.Popen[str]:
    line = command(out, *more)
    return subprocess.Popen(
        line, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=ENVIRONMENT
    )


def until(happened: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + SECONDS
    while not happened():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def epochs(run: Path) -> int:
    """Of the run's checkpoint."""
    return checkpoint.read(run)[1]["epoch"] if (run / checkpoint.FILE).exists() else 0


@pytest.fixture
def cluster(monkeypatch):
    """A head with Ray's client port, and a second node; each for one run at a time."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    node = {"num_cpus": 1, "object_store_memory": 80_000_000}
    nodes = Cluster(
        initialize_head=True,
        head_node_args=node | {"include_dashboard": False, "ray_client_server_port": port},
    )
    try:
        second = nodes.add_node(**node)
        yield nodes, second, f"ray://127.0.0.1:{port}"
    finally:
        nodes.shutdown()


def test_runs_of_a_node_that_dies_go_on_at_another(cluster, tmp_path):
    nodes, second, address = cluster
    out = tmp_path / "sweep"
    settings = Sweep(
        algorithms=("ppo", "lagnet"), cost_limits=(1.0,), seeds=(0,), out=out, tensorboard=False, **TINY
    )
    runs = {run.name: run for run in plan(settings)}
    mark = f"/{second.node_id[:4]}"
    hit: list[str] = []

    def well_on_the_way() -> bool:
        there = [n for n, run in runs.items() if str(read_holder(run.claim).get("node", "")).endswith(mark)]
        hit[:] = [name for name in there if epochs(runs[name].folder) >= 4]
        return bool(hit)

    process = call(out, "--address", address)
    try:
        until(well_on_the_way, process)
        nodes.remove_node(second, allow_graceful=False)
        _, said = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert process.returncode == 0, said
    (name,) = hit
    holder = read_holder(runs[name].claim)
    assert holder["attempt"] == 2
    assert not str(holder["node"]).endswith(mark)
    assert f"{name}: running on {holder['node']}" in said
    assert "2 of 2 runs finished" in said

    alone = train(replace(runs[name].config, out=tmp_path / "alone"))
    assert alone.finished
    assert (tmp_path / "alone/progress.csv").read_bytes() == (runs[name].folder / "progress.csv").read_bytes()
    rows = list(csv.DictReader((out / "summary.csv").open()))
    assert [(row["run"], row["state"], row["steps"]) for row in rows] == [
        (n, "finished", "20000") for n in runs
    ]

    before = {path: path.stat().st_mtime_ns for run in runs.values() for path in run.folder.iterdir()}
    again = subprocess.run(
        command(out, "--address", "ray://127.0.0.1:1"), capture_output=True, text=True, check=True
    )
    assert "2 of 2 runs finished" in again.stderr  # without so much as a cluster
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_ctrl_c_saves_every_run_and_says_how_to_go_on(tmp_path):
    out = tmp_path / "sweep"
    process = call(out, "--cores", "1", "--total-steps=2000000")
    try:
        until(lambda: epochs(out / "ppo-d1.0-s0") >= 2, process)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert "go on with the same command: lagnet-sweep --algorithms ppo lagnet" in said
    states = {row["run"]: row["state"] for row in csv.DictReader((out / "summary.csv").open())}
    assert states == {"ppo-d1.0-s0": "stopped", "lagnet-d1.0-s0": "stopped"}
    rows = (out / "ppo-d1.0-s0/progress.csv").read_text().splitlines()
    assert len(rows) == epochs(out / "ppo-d1.0-s0") + 1
    assert not (out / "lagnet-d1.0-s0").exists()
    assert (out / FOLDER / "driver").exists()
