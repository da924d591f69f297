"""Faults provoked on a real process: each ends in the safe action, says so, and is recorded."""

from __future__ import annotations

import http.client
import json
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from evaluation.service import Service
from recorder.reading import Reader

FAULTY = Path(__file__).with_name("faulty.py")
NAN, SLOW, HANGS, CRASHES = 11.0, 12.0, 13.0, 14.0
DEADLINE, READ = 0.1, 0.5
PLAN = [[0.05, -1.0], [0.03, 0.0]]
ADMIN, ACT = "admin-key", "act-key"

Ask = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def tapes(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("tapes")


@pytest.fixture(scope="module")
def service(tiny_bundle: Path, tapes: Path, tmp_path_factory, memory_key) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("keys")
    (folder / "memory").write_bytes(memory_key)
    (folder / "admin").write_text(ADMIN)
    (folder / "act").write_text(ACT)
    command = [sys.executable, str(FAULTY), str(tiny_bundle), "--port", "0", "--gate", "always"]
    command += ["--deadline-ms", str(1e3 * DEADLINE), "--max-age-ms", "300", "--hold-after-ms", "500"]
    command += ["--read-seconds", str(READ), "--drain-seconds", "0", "--record", str(tapes)]
    command += ["--memory-key-file", str(folder / "memory"), "--admin-key-file", str(folder / "admin")]
    command += ["--api-key-file", str(folder / "act")]
    with Service.run(command) as running:
        yield running


@pytest.fixture
def ask(service: Service, sealed) -> Iterator[Ask]:
    """Asks, as a robot of its own, with a stamp that is right unless said otherwise; the reply.

    With a `plan`, it has that in its memory.
    """
    link = http.client.HTTPConnection("127.0.0.1", int(service.url.rsplit(":", 1)[1]), timeout=10.0)
    robot = f"robot{time.monotonic_ns()}"

    def one(
        observation: list[float], status: int = 200, plan: list[list[float]] | None = None, **body: Any
    ) -> dict[str, Any]:
        asked = {"observation": observation, "robot": robot, "stamp": time.monotonic()} | body
        if plan is not None:
            asked["memory"] = sealed(plan, asked["robot"])
        link.request("POST", "/act", json.dumps(asked), {"x-api-key": ACT})
        reply = link.getresponse()
        content = reply.read()
        assert reply.status == status, content
        return {"robot": robot} | json.loads(content)

    yield one
    link.close()


def assert_safe(told: dict[str, Any], reason: str, action: list[float]) -> None:
    assert (told["mode"], told["action"]) == ("fallback", action), told
    assert reason in told["reason"]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (NAN, "the networks gave action [nan, nan]"),
        (SLOW, "no decision within 100 ms"),
        (HANGS, "no decision within 100 ms"),
        (CRASHES, "a fault in the filter"),
    ],
    ids=["nan", "slow", "hangs", "crashes"],
)
def test_a_fault_inside(service: Service, ask: Ask, observation, fault, reason) -> None:
    broken = [fault, *observation[1:]]
    assert ask(observation)["reason"] is None
    if fault == HANGS:  # once: such a thread never comes back
        assert_safe(ask(broken, plan=PLAN), reason, PLAN[0])
    else:
        memory: dict[str, Any] = {"plan": PLAN}
        for action in (*PLAN, [0.0, 0.0]):
            told = ask(broken, **memory)
            # Where the filter works, it is the one that goes on with the plan, and may make a new one.
            assert_safe(told, reason, told["action"] if fault == NAN else action)
            assert all(abs(number) <= 1.0 for number in told["action"])
            memory = {"memory": told["memory"]}
    # The next one is decided about as if nothing had been.
    deadline = time.monotonic() + 5.0
    while (told := ask(observation))["reason"] is not None and time.monotonic() < deadline:
        assert "hang" in told["reason"]
    assert told["reason"] is None


def test_an_observation_that_comes_late(ask: Ask, observation) -> None:
    for _ in range(5):
        assert ask(observation)["reason"] is None
    made = time.monotonic()
    time.sleep(0.4)
    told = ask(observation, stamp=made, plan=PLAN)
    assert_safe(told, "ms old", PLAN[0])
    assert ask(observation)["reason"] is None
    # It goes on being late: held, until somebody says otherwise.
    made = time.monotonic()
    time.sleep(0.35)
    while "held" not in (told := ask(observation, stamp=made, memory=told["memory"]))["reason"]:
        assert_safe(told, "ms old", told["action"])
        time.sleep(0.02)
    assert_safe(ask(observation, memory=told["memory"]), "held until it is reset", [0.0, 0.0])


def test_a_clock_that_jumps(service: Service, ask: Ask, observation) -> None:
    for stamp in (5.0, 4.0):
        told = ask(observation, stamp=stamp, plan=PLAN)
    assert_safe(told, "goes back by 1 s", PLAN[0])
    time.sleep(0.6)
    assert_safe(ask(observation, stamp=4.0, memory=told["memory"]), "held until it is reset", PLAN[1])
    link = http.client.HTTPConnection("127.0.0.1", int(service.url.rsplit(":", 1)[1]))
    link.request("POST", f"/robots/{told['robot']}/reset", b"", {"x-api-key": ADMIN})
    assert link.getresponse().status == 200
    assert ask(observation, stamp=1.0)["reason"] is None


def test_an_observation_without_a_stamp(ask: Ask, observation) -> None:
    assert_safe(ask(observation, stamp=None, plan=PLAN), "`stamp` is missing", PLAN[0])
    assert_safe(ask(observation, robot=None, plan=PLAN), "`robot` is missing", PLAN[0])


def test_who_sends_slowly_holds_up_nobody(service: Service, ask: Ask, observation) -> None:
    """Far more than the places for one address: they count from when their body has come."""
    port = int(service.url.rsplit(":", 1)[1])
    begun = [socket.create_connection(("127.0.0.1", port), timeout=10.0) for _ in range(200)]
    for link in begun:
        link.sendall(b"POST /act HTTP/1.1\r\nhost: x\r\nx-api-key: act-key\r\ncontent-length: 1000\r\n\r\n{")
    assert ask(observation)["reason"] is None
    for link in begun:
        assert link.recv(1000).startswith(b"HTTP/1.1 408 ")
        link.close()
    assert ask(observation)["reason"] is None


def test_nobody_sees_a_traceback_and_all_is_recorded(
    service: Service, tapes: Path, ask: Ask, observation
) -> None:
    """Runs last: it stops the service, in which one thread hangs still."""
    ask(observation, request=4242)
    ask(observation[1:], status=422)
    assert service.stop() == 0
    replies = []
    for file in sorted(tapes.glob("recording-*.mcap")):
        with Reader(file) as reader:
            replies += [json.loads(exchange.reply) for exchange in reader.exchanges()]
            assert reader.ended
            assert not reader.missing
    told = " ".join(str(reply["reason"]) for reply in replies)
    for reason in (
        "gave action [nan",
        "no decision within",
        "a fault in the filter",
        "ms old",
        "goes back",
        "held",
    ):
        assert reason in told
    assert "Traceback" not in told
    assert replies[-1]["request"] == 4242
    assert list(tapes.glob("incident-*.mcap"))
