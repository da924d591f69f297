"""Connections that say nothing, or a byte now and then, do not cost a robot its answer."""

from __future__ import annotations

import asyncio
import gc
import http.client
import json
import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

from evaluation.service import Service
from server import Client
from server.app import MAX_BODY, Lifecycle, create_app
from server.door import MAX_HEAD, Bounded, Connection, Door, Patience
from server.guard import Guard
from server.keys import Keys
from server.serve import DrainingServer, ServeConfig, ServeError, allow_files, listen, serve

READ, IDLE = 0.5, 1.5
ACT = b"POST /act HTTP/1.1\r\nhost: x\r\n"
HEALTH = b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n"

Connect = Callable[..., socket.socket]


@pytest.fixture(scope="module")
def service(tiny_bundle: Path) -> Iterator[Service]:
    command = [sys.executable, "-m", "server.serve", str(tiny_bundle), "--port", "0"]
    command += ["--read-seconds", str(READ), "--idle-seconds", str(IDLE), "--drain-seconds", "0"]
    with Service.run(command) as running:
        yield running


@pytest.fixture
def connect(service: Service) -> Iterator[Connect]:
    """Opens a connection to the service, or to another port."""
    with ExitStack() as opened:

        def one(port: int = 0) -> socket.socket:
            there = ("127.0.0.1", port or int(service.url.rsplit(":", 1)[1]))
            return opened.enter_context(socket.create_connection(there, timeout=10.0))

        yield one


def act(observation: list[float], key: str | None = None) -> bytes:
    body = json.dumps({"observation": observation}).encode()
    head = "" if key is None else f"authorization: Bearer {key}\r\n"
    return ACT + f"{head}content-length: {len(body)}\r\n\r\n".encode() + body


def answered(connection: socket.socket, request: bytes) -> http.client.HTTPResponse:
    connection.sendall(request)
    reply = http.client.HTTPResponse(connection)
    reply.begin()
    reply.read()
    return reply


def closed(connection: socket.socket, seconds: float) -> bool:
    """Whether the other side closes the connection in time; what it says before is dropped."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        if select.select([connection], [], [], left)[0]:
            try:
                if not connection.recv(65536):
                    return True
            except ConnectionError:
                return True
    return False


def test_silent_connections_starve_nobody(connect: Connect, observation) -> None:
    robot = connect()
    assert answered(robot, act(observation)).status == 200
    silent = [connect() for _ in range(600)]
    # The robot that was there, one that comes now, and the orchestrator.
    for request, link in (
        (act(observation), robot),
        (act(observation), connect()),
        (HEALTH, connect()),
        (HEALTH.replace(b"healthz", b"readyz"), connect()),
    ):
        started = time.monotonic()
        assert answered(link, request).status == 200
        assert time.monotonic() - started < 0.5
    assert all(closed(link, 2.0 * READ) for link in silent)
    assert answered(robot, act(observation)).status == 200


def test_half_requests_starve_nobody(connect: Connect, observation) -> None:
    """As silent ones: connections that owe the rest of a head or of a body hold no place."""
    for begun in (ACT, ACT + b"content-length: 1000\r\n\r\n{"):
        for _ in range(300):
            connect().sendall(begun)
    started = time.monotonic()
    assert answered(connect(), act(observation)).status == 200
    assert answered(connect(), HEALTH).status == 200
    assert time.monotonic() - started < 0.5


def test_whoever_sends_a_byte_now_and_then_is_closed_in_time(connect: Connect, observation) -> None:
    whole = act(observation)
    drips = {
        "nothing but line ends": (b"", b"\r\n"),
        "request line": (b"POST /", b"x"),
        "head": (ACT, b"x"),
        "body": (ACT + b"content-length: 1000\r\n\r\n", b" "),
        "chunked body": (ACT + b"transfer-encoding: chunked\r\n\r\n", b"1\r\n \r\n"),
        "head after an answer": (whole + ACT, b"x"),
        "body after an answer": (whole + ACT + b"content-length: 1000\r\n\r\n", b" "),
        "body of what is answered already": (
            b"POST /healthz HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n",
            b"1\r\n \r\n",
        ),
        "line ends after an answer": (whole, b"\r\n"),
    }
    links = {name: connect() for name in drips}
    for name, link in links.items():
        link.sendall(drips[name][0])
        link.setblocking(False)
    started = time.monotonic()
    lasted: dict[str, float] = {}
    said = dict.fromkeys(drips, b"")
    while len(lasted) < len(drips) and time.monotonic() - started < 3.0 * IDLE:
        for name in drips.keys() - lasted.keys():
            try:
                links[name].send(drips[name][1])
                received = links[name].recv(65536)
                said[name] += received
                gone = not received
            except BlockingIOError:
                gone = False
            except ConnectionError:
                gone = True
            if gone:
                lasted[name] = time.monotonic() - started
        time.sleep(0.05)
    assert lasted.keys() == drips.keys()
    between = lasted.pop("line ends after an answer")
    assert IDLE - 0.2 < between < IDLE + 1.0
    assert all(READ - 0.2 < seconds < READ + 1.0 for seconds in lasted.values()), lasted
    assert said["head"].startswith(b"HTTP/1.1 408 ")
    assert said["body after an answer"].count(b"HTTP/1.1 200 OK") == 1
    assert b"HTTP/1.1 408 " in said["body after an answer"]


@pytest.mark.long
def test_a_robot_that_keeps_its_connection_keeps_it(connect: Connect, observation) -> None:
    robot = connect()
    for pause in (0.1, 0.1, 0.1, READ + 0.2, 0.7 * IDLE, 0.0):
        assert answered(robot, act(observation)).status == 200
        time.sleep(pause)
    assert not closed(robot, 0.1)
    assert closed(robot, IDLE + 1.0)


def test_whoever_asks_far_ahead_of_the_answers_is_closed(connect: Connect, observation) -> None:
    link = connect()
    link.sendall(HEALTH * 10)
    said = b""
    while said.count(b"HTTP/1.1 200 OK") < 10:
        said += link.recv(65536)
    with suppress(ConnectionError):
        link.sendall(HEALTH * 20_000)
    assert closed(link, READ)
    assert answered(connect(), act(observation)).status == 200


def test_a_head_without_end_is_refused(connect: Connect) -> None:
    link = connect()
    with pytest.raises(ConnectionError):  # noqa: PT012
        link.sendall(ACT)
        for _ in range(100 * MAX_HEAD // 1000):
            link.sendall(b"x: " + b"y" * 995 + b"\r\n")
            time.sleep(0.001)
        link.recv(1)


@contextmanager
def serving(app: Guard, patience: Patience) -> Iterator[int]:
    """Runs an app behind a door, in a thread; its port."""
    settings = uvicorn.Config(app, http=Connection, ws="none", lifespan="off", log_level="error")
    server = DrainingServer(settings, Lifecycle(), 0.0, "", Door(patience, app.is_robots))
    listener = listen("127.0.0.1", 0, Keys())
    thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="module", params=[None, "sesame"], ids=["no key", "key"])
def key(request) -> str | None:
    """The key that the service for four robots asks for."""
    return request.param


@pytest.fixture(scope="module")
def small(monitor, key) -> Iterator[int]:
    """The port of a service for four robots."""
    with serving(create_app(monitor, keys=Keys(act=key)), Patience(robots=4)) as port:
        yield port


def test_the_robot_that_was_idle_longest_makes_room(small, key, connect: Connect, observation) -> None:
    robots = [connect(small) for _ in range(4)]
    for robot in (*robots, robots[0]):
        assert answered(robot, act(observation, key)).status == 200
    assert answered(connect(small), act(observation, key)).status == 200
    assert closed(robots[1], 1.0)
    for robot in (robots[0], *robots[2:]):
        assert answered(robot, act(observation, key)).status == 200


def test_a_request_that_is_answered_is_gone_without_the_collector(
    small, key, connect: Connect, observation
) -> None:
    """Garbage that only the collector finds grows for minutes before it looks through what is old."""
    robot = connect(small)
    gc.collect()
    gc.disable()
    try:
        for _ in range(40):
            assert answered(robot, act(observation, key)).status == 200
        kept = sum(type(one) is RequestResponseCycle for one in gc.get_objects())
    finally:
        gc.enable()
    assert kept < 10  # a connection's last one


@pytest.mark.parametrize(
    "path", ["/healthz", "/readyz", "/%68ealthz", "http://x/healthz", "/model", "/nothing", "/openapi.json"]
)
def test_whoever_asks_for_no_decision_costs_no_robot_its_connection(
    small, key, connect: Connect, observation, path: str
) -> None:
    """Health checks need no key: whoever can reach the service can make as many as they like."""
    robots = [connect(small) for _ in range(4)]
    for robot in robots:
        assert answered(robot, act(observation, key)).status == 200
    for _ in range(20):
        answered(connect(small), f"GET {path} HTTP/1.1\r\nhost: x\r\n\r\n".encode())
    for robot in robots:
        assert answered(robot, act(observation, key)).status == 200


def test_whoever_has_not_the_key_costs_no_robot_its_connection(
    small, key, connect: Connect, observation
) -> None:
    if key is None:
        pytest.skip("nobody has one")
    robots = [connect(small) for _ in range(4)]
    for robot in robots:
        assert answered(robot, act(observation, key)).status == 200
    for wrong in (None, "", "Sesame", key + key) * 5:
        assert answered(connect(small), act(observation, wrong)).status == 401
    for robot in robots:
        assert answered(robot, act(observation, key)).status == 200


def test_a_client_whose_idle_connection_is_taken_connects_anew(
    small, key, connect: Connect, observation
) -> None:
    with Client(f"http://127.0.0.1:{small}", timeout=5.0, api_key=key) as client:
        client.decide(observation)
        for _ in range(4):
            assert answered(connect(small), act(observation, key)).status == 200
        client.decide(observation)
        assert not client.faults.counts


async def reply(send: Send, body: bytes) -> None:
    headers = [(b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def test_while_every_robot_awaits_its_answer_others_are_told_to_come_back(connect: Connect) -> None:
    answer = threading.Event()

    async def slow(scope: Scope, receive: Receive, send: Send) -> None:
        while scope["path"] == "/act" and not answer.is_set():
            await asyncio.sleep(0.01)
        await reply(send, b"")

    with serving(Guard(slow, Keys(), MAX_BODY), Patience(robots=2)) as port:
        try:
            waiting = [connect(port) for _ in range(2)]
            for robot in waiting:
                robot.sendall(act([0.0]))
            time.sleep(0.3)
            late = answered(connect(port), act([0.0]))
            assert (late.status, late.getheader("retry-after")) == (503, "1")
            assert answered(connect(port), HEALTH).status == 200
            answer.set()
            for robot in waiting:
                assert answered(robot, b"").status == 200
            assert answered(connect(port), act([0.0])).status == 200
        finally:
            answer.set()


@pytest.mark.parametrize("requests", [1, 2])
def test_whoever_does_not_take_the_reply_is_closed_in_time(connect: Connect, requests: int) -> None:
    """It would hold the reply, and the next request, in memory for as long as it likes."""

    async def large(scope: Scope, receive: Receive, send: Send) -> None:
        await reply(send, bytes(20_000_000))

    with serving(Guard(large, Keys(), MAX_BODY), Patience(read=0.3)) as port:
        taker = connect(port)
        assert answered(taker, HEALTH).status == 200
        link = connect(port)
        for _ in range(requests):
            link.sendall(HEALTH)
            time.sleep(0.05)
        time.sleep(0.6)
        received = 0
        with suppress(ConnectionError):
            while part := link.recv(1_000_000):
                received += len(part)
        assert received < 20_000_000
        assert answered(taker, HEALTH).status == 200


def test_taking_a_reply_late_gives_no_more_time_for_what_has_begun() -> None:
    """Of a request as of a stream's frame."""

    class Plain(asyncio.Protocol):
        def __init__(self, *_: object) -> None:
            self.loop = SimpleNamespace(time=lambda: 100.0)

    class Caller(Bounded, Plain):
        awaits_answer = False

    one = Caller(uvicorn.Config("app"), Door(Patience(read=5.0, idle=75.0), lambda scope: True), {})
    one._reading = True
    one.pause_writing()
    one._allow(75.0)
    assert one.deadline == 105.0
    one.resume_writing()
    assert one.deadline == 105.0
    one._reading = False
    one._allow(75.0)
    assert one.deadline == 175.0


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["read_seconds", "idle_seconds"])
def test_deadlines_that_are_none_are_refused(tiny_bundle: Path, name: str, value: float) -> None:
    with pytest.raises(ServeError, match=f"--{name.replace('_', '-')}"):
        serve(ServeConfig(tiny_bundle, port=0, **{name: value}))


def test_more_connections_than_open_files_are_refused() -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] == resource.RLIM_INFINITY:
        pytest.skip("there is no limit")
    with pytest.raises(ServeError, match="--max-connections"):
        allow_files(before[1])
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == before
