"""The client always has an action, in time, whatever the other side does."""

from __future__ import annotations

import gzip
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic_core import to_json

from decision import MEMORY, PLAN_STEPS, Decision, Faults, pack
from evaluation.service import Service
from pointgoal.observation import layout
from server import Client, ClientError
from server.link import MAX_REPLY, DeadlineSocket
from server.schema import ModelReply, reply_of

Act = Callable[[socket.socket, bytes], None]


def http(body: bytes, status: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {status}\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body


def silence(connection: socket.socket, asked: bytes) -> None:
    time.sleep(0.6)


def trickle(connection: socket.socket, asked: bytes) -> None:
    for byte in http(b"{" + b" " * 100):
        connection.sendall(bytes([byte]))
        time.sleep(0.05)


def trickling_headers(connection: socket.socket, asked: bytes) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\n")
    for k in range(60):
        connection.sendall(f"x-{k}: 1\r\n".encode())
        time.sleep(0.05)


def dripping(head: bytes, part: bytes) -> Act:
    """Keeps the connection busy for ever, a little at a time."""

    def behaviour(connection: socket.socket, asked: bytes) -> None:
        connection.sendall(head)
        while True:
            connection.sendall(part)
            time.sleep(0.02)

    return behaviour


def endless(head: bytes, part: bytes) -> Act:
    def behaviour(connection: socket.socket, asked: bytes) -> None:
        connection.sendall(head)
        while True:
            connection.sendall(part)

    return behaviour


def hang_up(connection: socket.socket, asked: bytes) -> None:
    connection.shutdown(socket.SHUT_RDWR)


def says(reply: bytes, hangs_up: bool = False) -> Act:
    def behaviour(connection: socket.socket, asked: bytes) -> None:
        connection.sendall(reply)
        if hangs_up:
            connection.shutdown(socket.SHUT_RDWR)

    return behaviour


ACTION = [0.02, 0.5]
PLAN = [[-0.05, 0.25], [0.05, -1.0], [-0.03, 0.0]]


def text_of(plan: list[list[float]], **fields: int) -> str:
    """A memory as a service sends it."""
    memory = np.zeros(1, MEMORY)
    memory["planned"], memory["left"], memory["seal"] = True, len(plan), 7
    memory["plan"][0, : len(plan)] = np.reshape(plan, (-1, 2))
    for name, value in fields.items():
        memory[name] = value
    return pack(memory.tobytes())


def good(asked: bytes) -> dict[str, object]:
    """What a service answers that is in order; the model and the threshold are those of the tiny bundle."""
    return {
        "action": ACTION,
        "nominal_action": ACTION,
        "mode": "nominal",
        "origin": None,
        "certified": True,
        "barrier": 1.0,
        "hazard": None,
        "reason": None,
        "risk": 0.1,
        "threshold": 0.5,
        "opened_by": "always",
        "novelty": None,
        "suspect": None,
        "memory": text_of(PLAN, side=3),
        "plan": PLAN,
        "gate_open": True,
        "gate": "always",
        "model": MODEL[0],
        "request": json.loads(asked)["request"],
        "seconds": 0.001,
    }


MODEL = [""]
FIELDS = sorted(good(b'{"request": 0}'))


@pytest.fixture(autouse=True)
def _model(monitor) -> None:
    MODEL[0] = monitor.bundle.id


def replies(**changes: object) -> Act:
    """Answers well but for some fields."""
    return lambda connection, asked: connection.sendall(http(json.dumps(good(asked) | changes).encode()))


def in_turn(*behaviours: Act) -> Act:
    left = list(behaviours)

    def behaviour(connection: socket.socket, asked: bytes) -> None:
        left.pop(0)(connection, asked)

    return behaviour


def by_number(*behaviours: Act) -> Act:
    """Answers the first request with the first behaviour, and so on, whether or not the others arrive."""
    return lambda connection, asked: behaviours[json.loads(asked)["request"] - 1](connection, asked)


def planned(actions: list[list[float]] = PLAN) -> np.void:
    """A robot's memory that holds a plan."""
    memory = np.zeros(1, MEMORY)
    memory["side"], memory["planned"], memory["left"] = -4, True, len(actions)
    memory["plan"][0, : len(actions)] = actions
    return memory[0]


def assert_fallback(decision: Decision, reason: str, action: object = (0.0, 0.0), left: int = 0) -> None:
    assert (decision.mode, decision.origin, decision.opened_by) == ("fallback", "plan", "fault")
    assert reason in str(decision.reason)
    assert decision.action.tolist() == list(action)
    assert not decision.certified
    assert np.isnan([decision.risk, decision.barrier, *decision.nominal_action]).all()
    assert decision.threshold == 0.5
    assert len(decision.plan) == left


HUGE = b"HTTP/1.1 200 OK\r\ncontent-length: %b\r\n\r\n"
CHUNKED = b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n"
MISBEHAVIOUR = [
    (silence, "no reply within 0.3 s"),
    (trickle, "no reply within 0.3 s"),
    (trickling_headers, "no reply within 0.3 s"),
    (hang_up, "connection"),
    (says(b'HTTP/1.1 200 OK\r\ncontent-length: 500\r\n\r\n{"action": [1', True), "connection"),
    (says(b"SSH-2.0-OpenSSH_9.2\r\n"), "connection"),
    (says(http(b"", "503 Service Unavailable")), "answered 503"),
    (says(http(b'{"detail": "x"}', "422 Unprocessable")), "answered 422"),
    (says(http(b"", "302 Found")), "answered 302"),
    (says(http(b"not json")), "the reply is not one"),
    (says(http(b"{}")), "the reply is not one"),
    (says(http(b"[" * 100_000)), "the reply is not one"),
    (says(http(b"9" * 100_000)), "the reply is not one"),
    (says(HUGE % b"100000000000000000000"), "no length"),
    (says(HUGE % (b"9" * 5000)), "no length"),
    (says(HUGE % b"-1"), "no length"),
    (says(HUGE % b"nonsense"), "no length"),
    (says(HUGE % str(MAX_REPLY + 1).encode()), "no length"),
    (says(b"HTTP/1.1 200 OK\r\n\r\n{}", True), "no length"),
    (says(CHUNKED + b"FFFFFFFFFFFFFFFFFFFFFFFF\r\n{}"), "no length"),
    (says(CHUNKED + b"-1\r\n{}"), "no length"),
    (says(CHUNKED + b"nonsense\r\n"), "no length"),
    (endless(b"HTTP/1.1 200 OK\r\n", b"x: 1\r\n" * 1000), "connection"),
    (endless(b"HTTP/1.1 200 OK\r\n", b"x" * 5000), "connection"),
    (endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 100), "more than"),
    (endless(b"HTTP/1.1 200 OK\r\ncontent-length: 200000\r\nx: ", b"x" * 60_000), "connection"),
    (endless(b"HTTP/1.1 200 OK\r\ncontent-length: 200000\r\n\r\n", b" " * 5000), "the reply is not one"),
    (endless(b"", b"HTTP/1.1 102 Processing\r\n\r\n" * 100), "answered 102"),
    (endless(b"", b"HTTP/1.1 103 Early Hints\r\nlink: x\r\n\r\n" * 100), "answered 103"),
    (says(b"HTTP/1.1 101 Switching Protocols\r\nupgrade: websocket\r\n\r\n"), "answered 101"),
    (says(b"HTTP/1.1 99999999999999999999 OK\r\ncontent-length: 0\r\n\r\n"), "connection"),
    (says(b"HTTP/9.9 200 OK\r\ncontent-length: 2\r\n\r\n{}"), "connection"),
    (says(b"{}\r\n", True), "connection"),
    (says(b"\x00\xff" * 5000, True), "connection"),
    (says(b"HTTP/1.1 200 \xff\xfe\r\nx\xff: \x00\xff\r\ncontent-length: 3\r\n\r\n\xff\xfe{"), "no length"),
    (says(http(b"\xff\xfe{}")), "not one"),
    (says(b"HTTP/1.1 307 Go\r\nlocation: http://127.0.0.1:1/\r\ncontent-length: 0\r\n\r\n"), "answered 307"),
    (says(b"HTTP/1.1 204 No Content\r\n\r\n"), "answered 204"),
    (says(http(gzip.compress(b"{}")).replace(b"\r\n", b"\r\ncontent-encoding: gzip\r\n", 1)), "not one"),
    (says(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\ncontent-length: 900\r\n\r\n{}"), "not one"),
    (says(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\ntransfer-encoding: chunked\r\n\r\n2\r\n{}"), "no length"),
    (dripping(b"HTTP/1.1 200 OK\r\ncontent-length: 100000\r\n\r\n", b" "), "no reply within 0.3 s"),
    (dripping(b"HTTP/1.1 200 OK\r\nx: ", b"y"), "no reply within 0.3 s"),
    (dripping(b"", b"HTTP/1.1 100 Continue\r\n\r\n"), "no reply within 0.3 s"),
    (dripping(b"HTTP/1.1 100 Continue\r\n", b"x: 1\r\n"), "no reply within 0.3 s"),
]


@pytest.mark.parametrize(("behaviour", "reason"), MISBEHAVIOUR)
def test_a_service_that_misbehaves_leaves_the_robot_with_its_plan_in_time(
    fake, monitor, observation, behaviour, reason
) -> None:
    with fake(monitor, behaviour) as url, Client(url, timeout=0.3) as client:
        started = time.monotonic()
        decision = client.decide(observation, memory=planned())
        assert time.monotonic() - started < 0.5
        assert_fallback(decision, reason, PLAN[0], left=2)
        assert decision.memory["side"] == -4
        assert sum(client.faults.counts.values()) == 1
        assert client.faults.internal() == 0


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"action": [float("nan"), 0.0]}, "not one"),
        ({"action": None}, "not one"),
        ({"action": ["1", "2"]}, "not one"),
        ({"action": [1.0]}, "not one"),
        ({"action": [1.0, 0.0, 0.0]}, "not one"),
        ({"action": [1.0 + 1e-9, 0.0], "mode": "filtered"}, "an action out of bounds"),
        ({"action": [0.0, -1e300], "mode": "filtered"}, "an action out of bounds"),
        ({"mode": "reckless"}, "not one"),
        ({"mode": None}, "not one"),
        ({"origin": "hope"}, "not one"),
        ({"opened_by": "chance"}, "not one"),
        ({"certified": 1}, "not one"),
        ({"nominal_action": [0.02, 0.4]}, "nominal"),
        ({"nominal_action": None}, "nominal"),
        ({"memory": None}, "not one"),
        ({"memory": {"plan": PLAN}}, "not one"),
        ({"memory": "fast"}, "memory must be"),
        ({"memory": text_of(PLAN, left=PLAN_STEPS + 1)}, "a plan of 21 actions"),
        ({"memory": text_of([[0.0, 2.0]]), "plan": [[0.0, 2.0]]}, "a plan out of bounds"),
        ({"plan": [[0.0, 0.5]]}, "another plan than its memory"),
        ({"plan": None}, "not one"),
        ({"model": "other@000000000000"}, "of model other@000000000000"),
        ({"gate": "off"}, "of gate off"),
        ({"gate_open": False}, "both that its gate is open and that it is not"),
        ({"opened_by": None}, "both that its gate is open and that it is not"),
        ({"origin": "barrier"}, "comes from the barrier"),
        ({"hazard": -1}, "not one"),
        ({"hazard": 10**30}, "not one"),
        ({"threshold": 0.6}, "of threshold 0.6"),
        ({"threshold": None}, "of threshold nan"),
        ({"request": 99}, "of request 99"),
        ({"request": "1"}, "not one"),
    ],
)
def test_a_reply_that_is_not_to_be_trusted_is_not_followed(
    fake, monitor, observation, changes, reason
) -> None:
    behaviour = in_turn(replies(**changes), replies())
    with fake(monitor, behaviour) as url, Client(url, timeout=5.0) as client:
        assert_fallback(client.decide(observation, memory=planned()), reason, PLAN[0], left=2)
        assert client.decide(observation).action.tolist() == ACTION


def test_a_good_reply_is_the_decision(fake, monitor, observation) -> None:
    asked = []

    def behaviour(connection: socket.socket, body: bytes) -> None:
        asked.append(json.loads(body))
        replies()(connection, body)

    with fake(monitor, behaviour) as url, Client(url, timeout=5.0) as client:
        decision = client.decide(observation, [[1.0, 2.0]])
        assert (decision.mode, decision.reason, decision.risk) == ("nominal", None, 0.1)
        assert decision.plan.tolist() == PLAN
        client.decide(np.array(observation), memory=decision.memory)
    assert "memory" not in asked[0]
    assert asked[0]["hazards"] == [[1.0, 2.0]]
    assert asked[1]["memory"] == text_of(PLAN, side=3)
    assert asked[0]["observation"] == asked[1]["observation"] == observation
    assert asked[0]["request"] != asked[1]["request"]


def twice_at_once(connection: socket.socket, asked: bytes) -> None:
    connection.sendall(http(json.dumps(good(asked)).encode()) * 2)


def twice(connection: socket.socket, asked: bytes) -> None:
    replies()(connection, asked)
    time.sleep(0.1)
    replies()(connection, asked)


def ahead(connection: socket.socket, asked: bytes) -> None:
    """Answers, and then the next request as well, before anybody can have made it."""
    replies()(connection, asked)
    time.sleep(0.1)
    replies(request=2)(connection, asked)


@pytest.mark.parametrize("unasked", [twice, ahead])
def test_a_reply_that_comes_before_its_request_answers_none(fake, monitor, observation, unasked) -> None:
    last = replies(action=[0.0, 0.25], mode="filtered", origin="barrier")
    with fake(monitor, by_number(unasked, last)) as url, Client(url, timeout=5.0) as client:
        assert client.decide(observation).reason is None
        time.sleep(0.3)
        # What lies there unasked is not read as the next one's.
        assert client.decide(observation).action.tolist() == [0.0, 0.25]


def test_a_reply_that_comes_twice_answers_one_request(fake, monitor, observation) -> None:
    last = replies(action=[0.0, 0.25], mode="filtered", origin="barrier")
    # One that comes while the next is awaited is told by its number.
    again = replies(request=1)
    with fake(monitor, by_number(replies(), again, last)) as url, Client(url, timeout=5.0) as client:
        assert client.decide(observation).reason is None
        assert_fallback(client.decide(observation, memory=planned()), "of request 1, not 2", PLAN[0], left=2)
        assert client.decide(observation).action.tolist() == [0.0, 0.25]
    with fake(monitor, in_turn(twice_at_once, last)) as url, Client(url, timeout=5.0) as client:
        assert client.decide(observation).reason is None
        assert client.decide(observation).action.tolist() == [0.0, 0.25]


@settings(max_examples=300, deadline=None)
@given(
    content=st.binary(max_size=100)
    | st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(FIELDS), inner, max_size=17)
        ),
    ).map(lambda value: json.dumps(value).encode())
)
def test_nothing_that_is_sent_makes_it_raise(tiny_client, content) -> None:
    client, observation = tiny_client
    client._links[0][1].exchange = lambda *_: (200, content)
    assert client.decide(observation, memory=planned()).action.tolist() == PLAN[0]


def test_a_field_of_any_kind_does_not_make_it_raise(tiny_client) -> None:
    client, observation = tiny_client
    values = [None, True, -1, 10**400, 1e300, float("nan"), float("inf"), "", "x" * 5000, [], {}, [[]], [{}]]
    for name in FIELDS:
        for value in values:
            client._session._request = 0
            body = json.dumps(good(b'{"request": 1}') | {name: value}).encode()
            client._links[0][1].exchange = lambda *_, body=body: (200, body)
            assert np.isfinite(client.decide(observation, memory=planned()).action).all()


@pytest.fixture(scope="module")
def tiny_client(fake, monitor):
    """A client whose connection a test replaces, and an observation."""
    with fake(monitor, silence) as url, Client(url, timeout=5.0, most_failures=None) as client:
        yield client, [0.25] * 60


@pytest.mark.parametrize(
    "error", [MemoryError(), RecursionError("deep"), OverflowError("large"), KeyError("x"), UnicodeError("x")]
)
def test_whatever_is_raised_inside_is_caught_counted_and_logged_once(
    fake, monitor, observation, caplog, error
) -> None:
    with fake(monitor, silence) as url, Client(url) as client:

        def broken(*_: object) -> None:
            raise error

        client._links[0][1].exchange = broken
        with caplog.at_level(logging.WARNING, "lagnet.client"):
            for _ in range(7):
                assert client.decide(observation, memory=planned()).action.tolist() == PLAN[0]
        assert len(caplog.records) == 1
        assert sum(client.faults.counts.values()) == 7


def test_ctrl_c_goes_through(fake, monitor, observation) -> None:
    with fake(monitor, silence) as url, Client(url) as client:

        def interrupted(*_: object) -> None:
            raise KeyboardInterrupt

        client._links[0][1].exchange = interrupted
        with pytest.raises(KeyboardInterrupt):
            client.decide(observation)


def test_the_plan_is_played_to_its_end_and_then_the_robot_coasts(fake, monitor, observation) -> None:
    behaviour = in_turn(replies(), *[hang_up] * 20)
    with fake(monitor, behaviour) as url, Client(url, timeout=5.0) as client:
        decision = client.decide(observation)
        played = []
        for left in (2, 1, 0, 0, 0):
            decision = client.decide(observation, memory=decision.memory)
            assert len(decision.plan) == left
            played.append(decision.action.tolist())
        assert played == [*PLAN, [0.0, 0.0], [0.0, 0.0]]


def test_it_goes_on_after_a_fault(fake, monitor, observation) -> None:
    other = replies(action=[0.25, 0.0], mode="filtered", origin="barrier")
    with (
        fake(monitor, in_turn(silence, replies(), hang_up, other)) as url,
        Client(url, timeout=0.3) as client,
    ):
        assert client.decide(observation).mode == "fallback"
        assert client.decide(observation).action.tolist() == ACTION
        # The third answer hangs up on a kept connection: asked once more on a fresh one.
        assert client.decide(observation).action.tolist() == [0.25, 0.0]


@pytest.mark.parametrize(
    "bad",
    [
        [float("nan")] * 60,
        [float("inf")] * 60,
        ["x"] * 60,
        [10**400],
        None,
        [0.0] * 59,
        [[0.0] * 60],
        object(),
    ],
)
def test_what_cannot_be_sent_leaves_the_robot_with_its_plan(fake, monitor, bad) -> None:
    with fake(monitor, replies()) as url, Client(url, timeout=5.0) as client:
        assert_fallback(client.decide(bad, memory=planned()), "bad input", PLAN[0], left=2)
        # The connection is as good as before.
        assert client.decide([0.0] * 60).action.tolist() == ACTION


@pytest.mark.parametrize("bad", [[[float("nan"), 0.0]], "x", 10**400])
def test_hazards_that_cannot_be_sent(fake, monitor, observation, bad) -> None:
    with fake(monitor, replies()) as url, Client(url, timeout=5.0) as client:
        assert_fallback(client.decide(observation, bad, planned()), "bad input", PLAN[0], left=2)


@pytest.mark.parametrize(
    "memory",
    [
        np.zeros(2, MEMORY),
        np.zeros(0, MEMORY),
        np.zeros(1),
        {"side": 0, "guided": 0, "open": 0, "plan": PLAN},
        planned([[float("nan"), 0.0]]),
        planned([[0.0, 1.5]]),
    ],
    ids=["two", "none", "numbers", "json", "nan", "out of bounds"],
)
def test_a_memory_that_is_none_is_not_played(fake, monitor, observation, memory) -> None:
    with fake(monitor, replies()) as url, Client(url, timeout=5.0) as client:
        assert_fallback(client.decide(observation, memory=memory), "bad input")


def test_every_address_of_a_host_is_tried(fake, monitor, observation, monkeypatch) -> None:
    with fake(monitor, replies()) as url:
        port = int(url.rsplit(":", 1)[1])
        asked = []
        dead = socket.create_server(("127.0.0.1", 0))
        dead_port = dead.getsockname()[1]
        dead.close()

        def two(host: str, port: int, **_: object) -> list[tuple[object, ...]]:
            asked.append(host)
            kind = (socket.AF_INET, socket.SOCK_STREAM, 6, "")
            return [(*kind, ("127.0.0.1", dead_port)), (*kind, ("127.0.0.1", port))]

        monkeypatch.setattr(socket, "getaddrinfo", two)
        with Client(f"http://localhost:{port}", timeout=5.0) as client:
            client._links[0][1].close()
            assert client.decide(observation).reason is None
        # A look-up may take seconds: never again while the robot moves.
        assert asked == ["localhost"]


def test_the_real_service_and_after_its_end(tiny_bundle: Path, monitor, observation) -> None:
    with Service.start(tiny_bundle, "always") as service:
        client = Client(service.url, layout(1).to_json(), timeout=5.0)
        assert client.model().model == monitor.bundle.id
        memory = past = None
        for hazards in ([[0.45, 0.0]], None, [[0.3, 0.1], [1.0, 1.0]]):
            told, decided = (
                client.decide(observation, hazards, memory),
                monitor.decide(observation, hazards, past),
            )
            memory, past = told.memory, decided.memory
            unsealed = memory.copy()
            unsealed["seal"] = 0
            assert unsealed.tobytes() == past.tobytes()
            assert told.action.tobytes() == decided.action.tobytes()
            for name in (
                "mode",
                "origin",
                "certified",
                "barrier",
                "hazard",
                "risk",
                "threshold",
                "opened_by",
            ):
                assert getattr(told, name) == getattr(decided, name)
        assert "bad input" in str(client.decide(observation[:-1]).reason)
    assert_fallback(client.decide(observation, memory=planned()), "connection", PLAN[0], left=2)
    client.close()


def test_clients_of_one_service_do_not_mix(fake, monitor, observation) -> None:
    """Each gets the answer to its own request, also in threads."""

    def behaviour(connection: socket.socket, asked: bytes) -> None:
        turn = json.loads(asked)["observation"][0]
        replies(action=[0.0, turn], mode="filtered", origin="barrier")(connection, asked)

    with fake(monitor, behaviour) as url:
        wrong = []

        def drive(turn: float) -> None:
            with Client(url, timeout=5.0) as client:
                for _ in range(50):
                    decision = client.decide([turn, *observation[1:]])
                    if decision.action.tolist() != [0.0, turn]:
                        wrong.append(decision)

        threads = [threading.Thread(target=drive, args=(k / 10,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []


def test_another_observation_layout_is_refused_before_the_robot_moves(fake, monitor) -> None:
    with fake(monitor, replies()) as url:
        Client(url, layout(1).to_json()).close()
        with pytest.raises(ClientError, match="another observation layout"):
            Client(url, layout(0).to_json())


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1:1",
        "127.0.0.1:8000",
        "ftp://x",
        "http://",
        "http://x:y",
        "http://h/p",
        f"http://{'a' * 70}",
    ],
)
def test_a_service_that_is_not_there_is_an_error_at_connect(url: str) -> None:
    with pytest.raises(ClientError):
        Client(url)


@pytest.mark.parametrize(
    "model",
    [
        http(b"{}"),
        http(b"hello"),
        http(b"", "404 Not Found"),
        b"nonsense\r\n\r\n",
        HUGE % b"100000000000000000000",
        CHUNKED + b"FFFFFFFFFFFFFFFFFFFF\r\n",
        http(b"[" * 100_000),
    ],
)
def test_what_is_no_lagnet_service_is_an_error_at_connect(fake, monitor, model: bytes) -> None:
    with fake(monitor, replies(), model) as url, pytest.raises(ClientError):
        Client(url)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"action_high": [1e300, 1.0]}, "bounds in -1..1"),
        ({"action_low": [-1.0, -1.5]}, "bounds in -1..1"),
        ({"action_low": [0.9, -1.0]}, "bounds in -1..1"),
        ({"action_low": [0.0, -1.0], "action_high": [0.0, 1.0]}, "bounds in -1..1"),
        ({"action_low": [1.0, 1.0], "action_high": [-1.0, -1.0]}, "bounds in -1..1"),
        ({"observation_size": 59}, "its layout has 60"),
        ({"observation_size": 10**30}, "its layout has 60"),
        ({"observation_layout": []}, "its layout has 0"),
    ],
)
def test_a_model_that_no_robot_should_follow_is_refused_at_connect(fake, monitor, changes, named) -> None:
    told = json.loads(ModelReply.of(monitor).model_dump_json()) | changes
    with fake(monitor, replies(), http(json.dumps(told).encode())) as url:
        with pytest.raises(ClientError, match=named) as caught:
            Client(url)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "error", [MemoryError(), RecursionError("deep"), OverflowError("large"), KeyError("x"), UnicodeError("x")]
)
def test_whatever_is_raised_at_connect_is_one_error(monkeypatch, error) -> None:
    def broken(*_: object) -> None:
        raise error

    monkeypatch.setattr("server.link.Link.exchange", broken)
    with pytest.raises(ClientError, match="http://x"):
        Client("http://x")


def test_what_a_service_says_cannot_write_log_lines(fake, monitor, observation, caplog) -> None:
    bad = http(b"x\nWARNING all is well\x1b[2J\r\n", "500 Internal")
    with fake(monitor, says(bad)) as url, Client(url, timeout=5.0) as client:
        reason = client.decide(observation).reason
        assert "all is well" in reason
        assert reason.isprintable()
        assert all(record.getMessage().isprintable() for record in caplog.records)
    with fake(monitor, replies(), bad) as url:
        with pytest.raises(ClientError) as caught:
            Client(url)
        assert str(caught.value).isprintable()


def garbled(reply: bytes) -> Iterator[bytes]:
    """A reply that is wrong at one place, for every place."""
    for k in range(len(reply)):
        yield reply[:k]
        yield reply[:k] + reply[k + 1 :]
        for byte in (b"\x00", b"\xff", b"9", b"-", b"\n", b"]", b"{"):
            yield reply[:k] + byte + reply[k + 1 :]
            yield reply[:k] + byte + reply[k:]


@pytest.fixture
def wired(monkeypatch) -> Callable[[bytes], None]:
    """Makes every new connection one that brings a given reply, whatever is asked, and then ends."""
    replies: list[bytes] = []

    def opened(*_: object) -> DeadlineSocket:
        here, there = socket.socketpair()
        with there:
            there.sendall(replies[-1])
            there.shutdown(socket.SHUT_WR)
            here.settimeout(1.0)
            kept.append(there.dup())
        return DeadlineSocket(here.family, here.type, here.proto, here.detach())

    kept: list[socket.socket] = []
    monkeypatch.setattr("server.link._open", opened)

    def bring(reply: bytes) -> None:
        replies.append(reply)
        while kept:
            kept.pop().close()

    return bring


def test_a_reply_garbled_anywhere_is_survived(wired, monitor, observation) -> None:
    about = http(ModelReply.of(monitor).model_dump_json().encode())
    wired(about)
    client = Client("http://127.0.0.1:1", timeout=5.0, most_failures=None)
    client.faults = Faults("lagnet.test")
    client._links[0][1]._greet = None  # the one reply is the next request's
    body = json.dumps(good(b'{"request": 1}')).encode()
    nominal = 0
    for reply in (*garbled(http(body)), *map(http, garbled(body))):
        client._links[0][1].close()
        client._session._request = 0
        wired(reply)
        decision = client.decide(observation, memory=planned())
        assert (np.abs(decision.action) <= 1.0).all()
        assert (np.abs(decision.plan) <= 1.0).all()
        if decision.reason is not None:
            assert decision.action.tolist() == PLAN[0]
        nominal += decision.reason is None
    assert 0 < nominal < sum(client.faults.counts.values())
    assert client.faults.internal() == 0


def test_a_model_garbled_anywhere_is_survived_at_connect(wired, monitor) -> None:
    body = ModelReply.of(monitor).model_dump_json().encode()
    refused = 0
    for reply in (*list(garbled(http(body)))[:1500], *map(http, list(garbled(body))[::7])):
        wired(reply)
        try:
            with Client("http://127.0.0.1:1", timeout=5.0) as client:
                assert (np.abs(client._session._low) <= 1.0).all()
                assert (np.abs(client._session._high) <= 1.0).all()
        except ClientError:
            refused += 1
    assert refused > 1000


def test_a_robot_with_many_open_files_is_served(fake, monitor, observation) -> None:
    """select() cannot watch what is numbered 1024 or above."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1200:
        pytest.skip("so many files may not be open")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1200), hard))
    try:
        with ExitStack() as files:
            while files.enter_context(Path(os.devnull).open()).fileno() < 1030:
                pass
            url = files.enter_context(fake(monitor, replies()))
            client = files.enter_context(Client(url, timeout=5.0))
            assert [client.decide(observation).reason for _ in range(3)] == [None] * 3
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(timeout: float) -> None:
    with pytest.raises(ValueError, match="timeout"):
        Client("http://127.0.0.1:1", timeout=timeout)


@pytest.mark.parametrize("key", ["two\r\nx-other: header", "schl\u00fcssel"])
def test_a_key_that_no_header_can_carry_is_refused(key: str) -> None:
    with pytest.raises(ValueError, match="API key"):
        Client("http://127.0.0.1:1", api_key=key)


def test_the_fakes_good_reply_is_one_that_the_service_could_send(monitor, observation) -> None:
    decided = monitor.decide(observation)
    real = to_json(reply_of(decided, pack(decided.memory.tobytes()), 1, monitor.bundle.id, "always", 0.001))
    assert set(json.loads(real)) == set(FIELDS)
