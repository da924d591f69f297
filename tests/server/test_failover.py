"""Real services that end, change, and stand in for each other while a robot drives."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evaluation.service import Service
from server import AsyncClient, Client, ClientError, StepError

Services = list[Service]
OBSERVATION = [0.25] * 60
NEAR = [[0.3, 0.03]]


def start(bundle: Path, key: Path, port: int = 0, gate: str = "always") -> Service:
    words = ["-m", "server.serve", str(bundle), "--gate", gate, "--memory-key-file", str(key)]
    return Service.run([sys.executable, *words, "--port", str(port)])


@pytest.fixture(scope="module")
def key(tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("key") / "key"
    path.write_bytes(os.urandom(32))
    return path


@pytest.fixture(scope="module")
def standby(tiny_bundle: Path, key: Path) -> Iterator[Service]:
    """The second of two services, which lives on."""
    with start(tiny_bundle, key) as service:
        yield service


def streamed(url: str) -> str:
    return url.replace("http", "ws")


@pytest.mark.parametrize("scheme", [str, streamed])
def test_a_service_that_is_killed_costs_no_step_where_another_stands_by(
    tiny_bundle, key, standby, scheme
) -> None:
    with start(tiny_bundle, key) as first:
        urls = [scheme(first.url), scheme(standby.url)]
        with Client(urls, timeout=2.0, robot=f"kill-{scheme.__name__}") as client:
            memory = None
            for step in range(40):
                decision = client.decide(OBSERVATION, NEAR, memory)
                assert decision.reason is None or "no certified" in decision.reason, (step, decision.reason)
                assert decision.opened_by == "always"
                memory = decision.memory
                if step == 20:
                    first.process.send_signal(signal.SIGKILL)
                    first.process.wait()
            assert not client.faults.counts


def test_without_another_the_robot_plays_its_plan_then_holds_until_it_is_told_to_resume(
    tiny_bundle, key
) -> None:
    with start(tiny_bundle, key) as first:
        port = int(first.url.rsplit(":", 1)[1])
        client = Client(first.url, timeout=2.0, robot="alone", most_failures=3)
        memory = client.decide(OBSERVATION, NEAR).memory
        plan = np.array(memory["plan"][: memory["left"]])
        assert len(plan)
        first.process.send_signal(signal.SIGKILL)
        first.process.wait()
    for k in range(5):
        decision = client.decide(OBSERVATION, NEAR, memory)
        assert (decision.mode, decision.opened_by) == ("fallback", "fault")
        assert decision.action.tolist() == (plan[k].tolist() if k < len(plan) else [0.0, 0.0])
        assert ("until resume()" in str(client.held)) == (k >= 2)
        memory = decision.memory
    with pytest.raises(ClientError):
        client.resume()
    assert client.held is not None
    # Started anew, it takes the memory that it had sealed in its former life, but for what was played.
    with start(tiny_bundle, key, port):
        decision = client.decide(OBSERVATION, NEAR, memory)
        assert "held" in str(decision.reason)
        memory = decision.memory
        client.resume()
        decision = client.decide(OBSERVATION, NEAR, memory)
        assert decision.opened_by == "always"
        assert client.held is None
        client.close()


@pytest.mark.parametrize("scheme", [str, streamed])
def test_a_service_that_runs_something_else_after_a_reconnect_is_not_followed(
    tiny_bundle, key, scheme
) -> None:
    with start(tiny_bundle, key) as first:
        port = int(first.url.rsplit(":", 1)[1])
        client = Client(scheme(first.url), timeout=2.0)
        memory = client.decide(OBSERVATION, NEAR).memory
    with start(tiny_bundle, key, port, gate="risk"):
        for _ in range(3):
            decision = client.decide(OBSERVATION, NEAR, memory)
            assert "which is not" in str(decision.reason)
            assert "gate" in str(decision.reason)
            assert decision.opened_by == "fault"
        client.resume()
        assert client.model().gate == "risk"
        assert client.decide(OBSERVATION, NEAR, memory).opened_by != "fault"
        client.close()


def test_two_services_that_run_different_things_are_refused_before_the_robot_moves(
    tiny_bundle, key, standby
) -> None:
    with (
        start(tiny_bundle, key, gate="risk") as other,
        pytest.raises(ClientError, match=r"gate.* differ"),
    ):
        Client([standby.url, other.url])


def test_one_of_several_that_is_away_does_not_keep_the_robot_from_starting(standby) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
    with Client([url, standby.url], timeout=2.0) as client:
        assert client.decide(OBSERVATION).opened_by == "always"
        assert client.decide(OBSERVATION).opened_by == "always"


def test_a_service_that_hangs_leaves_time_for_another(standby, fake, monitor) -> None:
    hung: list[socket.socket] = []
    with (
        fake(monitor, lambda connection, _: hung.append(connection)) as url,
        Client([url, standby.url], timeout=1.0) as client,
    ):
        assert client.decide(OBSERVATION).opened_by == "always"
        # From then on it is the other that is asked first.
        assert client.decide(OBSERVATION).opened_by == "always"
        assert len(hung) <= 1


def test_the_async_client_decides_fails_over_and_holds(tiny_bundle, key, standby) -> None:
    async def drive() -> None:
        with start(tiny_bundle, key) as first:
            async with AsyncClient([first.url, standby.url], timeout=2.0, robot="async") as client:
                memory = None
                with Client(standby.url, timeout=2.0) as reference:
                    same = reference.decide(OBSERVATION, NEAR).action.tolist()
                for step in range(20):
                    decision = await client.decide(OBSERVATION, NEAR, memory)
                    assert decision.opened_by == "always", decision.reason
                    memory = decision.memory
                    if step == 0:
                        assert decision.action.tolist() == same
                    if step == 10:
                        first.process.send_signal(signal.SIGKILL)
                        first.process.wait()
                assert "bad input" in str((await client.decide(OBSERVATION[1:])).reason)
            with pytest.raises(ClientError, match="asks over http"):
                AsyncClient(streamed(standby.url))
            with pytest.raises(ClientError):
                async with AsyncClient(first.url):
                    pass

    asyncio.run(drive())


def test_the_async_client_keeps_its_deadline_and_holds(fake, monitor) -> None:
    async def drive(url: str) -> None:
        async with AsyncClient(url, timeout=0.05, most_failures=2) as client:
            for _ in range(2):
                assert "no reply within 0.05 s" in str((await client.decide(OBSERVATION)).reason)
            assert "until resume()" in str(client.held)
            assert "held" in str((await client.decide(OBSERVATION)).reason)
            await client.resume()
            assert client.held is None
        async with AsyncClient(url, timeout=0.05, raises=True) as client:
            with pytest.raises(StepError, match="no reply"):
                await client.decide(OBSERVATION)

    hung: list[socket.socket] = []
    with fake(monitor, lambda connection, _: hung.append(connection)) as url:
        asyncio.run(drive(url))


def test_a_restart_with_a_new_key_does_not_leave_the_robot_stuck(tiny_bundle, tmp_path) -> None:
    keys = [tmp_path / "one", tmp_path / "two"]
    for path in keys:
        path.write_bytes(os.urandom(32))
    with start(tiny_bundle, keys[0]) as first:
        port = int(first.url.rsplit(":", 1)[1])
        client = Client(first.url, timeout=2.0, robot="one")
        memory = client.decide(OBSERVATION, NEAR).memory
    with start(tiny_bundle, keys[1], port):
        lost = client.decide(OBSERVATION, NEAR, memory)
        assert (lost.mode, lost.opened_by) == ("fallback", "fault")
        assert "not one that this service sent" in str(lost.reason)
        # The service decided on what it sees; from here on it goes on as ever.
        after = client.decide(OBSERVATION, NEAR, lost.memory)
        assert after.opened_by == "always"
        client.close()
