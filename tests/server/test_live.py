"""What the live page is told, and the files that it is made of."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from decision import MEMORY, Decision, Mode
from evaluation.service import Service
from filter import FilterConfig
from monitor import Monitor
from server import live
from server.app import create_app
from server.keys import Keys, Level, needed
from server.live import Hub, Robot
from server.observer import Answered
from server.schema import ActRequest
from server.view import Views

PAGE = Path(live.__file__).parent / "page"
SEVERITY = ("nominal", "guided", "filtered", "fallback")


@pytest.fixture(scope="module")
def views(monitor: Monitor) -> Views:
    return Views(monitor, FilterConfig())


@pytest.fixture(scope="module")
def decision(monitor: Monitor) -> Decision:
    return monitor.decide([0.25] * 60)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class Standing:
    def snapshot(self) -> dict[str, Any]:
        return {"state": "ready", "alarms": [], "counters": {}, "model": "tiny"}


def answered(asked: ActRequest, *decisions: Decision, client: tuple[str, int] = ("h", 1)) -> Answered:
    return Answered(0, client, "/act", b"", 0.001, 200, b"", [asked] * len(decisions), decisions)


def asks(robot: str | None = None, **more: object) -> ActRequest:
    return ActRequest.model_validate({"observation": [0.25] * 60, "robot": robot} | more)


async def told(hub: Hub, updates: int = 1, robot: str | None = None) -> list[dict[str, Any]]:
    """What a watcher is told: first the `about`."""
    stream = hub.stream(robot)
    found = []
    async for event in stream:
        found.append(json.loads(event.partition("data: ")[2]))
        if len(found) > updates:
            break
    await stream.aclose()
    return found


steps = st.lists(
    st.tuples(
        st.sampled_from(list(Mode)),
        st.floats(0.0, 9.0) | st.just(float("nan")),
        st.floats(-1.0, 3.0) | st.just(float("nan")),
        st.floats(0.0, 1.0),
    ),
    min_size=1,
    max_size=8,
)


@given(steps)
def test_no_decision_between_two_updates_is_lost(decision: Decision, taken) -> None:
    """The severest mode, the highest risk, the lowest barrier and the slowest answer are told."""
    robot = None
    for place, (mode, risk, barrier, seconds) in enumerate(taken):
        one = replace(decision, mode=mode, risk=risk, barrier=barrier, reason=str(place))
        if robot is None:
            robot = Robot(asks(), one, seconds, 1.0)
        else:
            robot.note(asks(), one, seconds, 1.0)
    since = robot.told(1.5)["since"]
    modes, risks, barriers, seconds = zip(*taken, strict=True)
    worst = max(modes, key=SEVERITY.index)
    assert since["mode"] == worst
    assert since["reason"] == str(len(modes) - 1 - modes[::-1].index(worst))
    assert since["risk"] == (None if np.isnan(risks).any() else max(risks))
    assert since["barrier"] == (None if np.isnan(barriers).any() else min(barriers))
    assert since["seconds"] == max(seconds)
    assert robot.told(1.5)["age"] == 0.5
    assert robot.told(1.5)["steps"] == len(taken)
    robot.begin()
    assert robot.told(1.5)["since"] is None


def test_the_stream_tells_what_the_service_is_and_then_every_robot(views, decision) -> None:
    hub = Hub(views, Standing(), {"gate": "risk"})
    hub.answered(answered(asks("ada"), decision))
    hub.answered(answered(asks(), decision, decision, client=("h", 7)))
    about, update = asyncio.run(told(hub))
    assert about == {"gate": "risk"}
    assert list(update["robots"]) == ["ada", "h:7/1", "h:7/2"]
    assert update["operation"] == Standing().snapshot()
    assert (update["looked"], update["view"]["problem"]) == ("ada", None)
    [_, update] = asyncio.run(told(hub, robot="h:7/2"))
    assert update["looked"] == "h:7/2"
    [_, update] = asyncio.run(told(hub, robot="nobody"))
    assert update["looked"] == "ada"


def test_robots_that_are_heard_are_not_displaced_by_made_up_names(views, decision) -> None:
    clock = Clock()
    hub = Hub(views, Standing(), {}, clock)
    known = [f"r{i}" for i in range(live.MOST_ROBOTS)]
    for name in known:
        hub.answered(answered(asks(name), decision))
    for i in range(500):
        hub.answered(answered(asks(f"made-up-{i}"), decision))
    [_, update] = asyncio.run(told(hub))
    assert set(update["robots"]) == set(known)
    assert update["crowded"]
    clock.now += 5.0
    for name in known[1:]:
        hub.answered(answered(asks(name), decision))
    for _ in known:
        hub.answered(answered(asks("new"), decision))
    [_, update] = asyncio.run(told(hub))
    assert set(update["robots"]) == {*known[1:], "new"}


def test_a_watcher_that_does_not_read_is_dropped(views, decision) -> None:
    async def watch() -> None:
        hub = Hub(views, Standing(), {}, patience=0.25)
        hub.answered(answered(asks("ada"), decision))
        idle, busy = hub.stream(None), hub.stream(None)
        await anext(idle)
        await anext(idle)
        for _ in range(6):
            await anext(busy)
        assert hub.watchers == 1
        with pytest.raises(StopAsyncIteration):
            await anext(idle)
        await busy.aclose()
        assert hub.watchers == 0

    asyncio.run(watch())


def test_watchers_are_bounded_and_end_with_the_service(views) -> None:
    async def watch() -> None:
        hub = Hub(views, Standing(), {})
        streams = [hub.stream(None) for _ in range(live.MOST_WATCHERS)]
        for stream in streams:
            await anext(stream)
        assert hub.full
        with pytest.raises(StopAsyncIteration):
            await anext(hub.stream(None))
        hub.close()
        for stream in streams:
            with pytest.raises(StopAsyncIteration):
                await anext(stream)
        assert hub.full
        assert hub.watchers == 0

    asyncio.run(watch())


def test_a_fault_of_the_page_ends_its_streams_alone(views, decision) -> None:
    class Broken:
        def snapshot(self) -> dict[str, Any]:
            raise RuntimeError("broken")

    async def watch() -> None:
        hub = Hub(views, Broken(), {})
        assert [event.startswith("event: about") async for event in hub.stream(None)] == [True]
        assert hub.faults.counts["RuntimeError"] == 1
        hub.answered(answered(asks("ada"), decision))

    asyncio.run(watch())


def test_an_address_may_be_a_list(views, decision) -> None:
    """As some servers give it."""
    hub = Hub(views, Standing(), {})
    hub.answered(answered(asks(), decision, client=["h", 1]))
    [_, update] = asyncio.run(told(hub))
    assert list(update["robots"]) == ["h:1/1"]


def test_the_view_is_what_the_filter_sees(hand, monitor: Monitor, views: Views) -> None:
    """Against the tests' own dynamics: the path is that of the action and of the plan."""
    places = np.array([[0.32, 0.05], [-0.9, 0.4]])
    observation = hand.observe(places, velocity=(0.9, 0.1), yaw_rate=0.7, goal=(1.0, -1.0))
    observation[9:11] = -0.5 * np.sin(0.3), -0.5 * np.cos(0.3)
    made = monitor.decide(observation, places)
    assert (made.hazard, made.mode) == (0, Mode.FILTERED)
    assert len(made.plan) > 3
    seen = views.of(ActRequest(observation=observation.tolist(), hazards=places.tolist()), made)
    assert json.loads(json.dumps(seen, allow_nan=False)) == seen
    assert seen["heading"] == pytest.approx(0.3)
    assert seen["velocity"] == pytest.approx([0.9, 0.1])
    assert seen["goal"] == pytest.approx([1.0, -1.0], abs=1e-3)
    assert seen["given"] == [[0.32, 0.05, 0], [-0.9, 0.4, 1]]
    assert seen["likely"] == []
    assert seen["blamed"] == 0
    assert seen["action"] == pytest.approx(made.action, abs=1e-4)
    ahead = [row for row in seen["obstacles"] if row[6] == 0]
    assert ahead == [[0.32, 0.05, 0.0, 0.0, pytest.approx(0.21), 0.0, 0]]
    state = np.array([0.0, 0.0, 0.0, 0.9, 0.1, 0.7])
    way = []
    for action in [made.action, *made.plan, *np.zeros((200, 2))]:
        state = hand.step_exactly(state, action)
        way.append(state[:2])
        if len(way) > len(made.plan) + 1 and np.hypot(*state[3:5]) < 0.02:
            break
    assert seen["path"][0] == [0.0, 0.0]
    assert seen["path"][-1] == pytest.approx(way[-1].tolist(), abs=2e-3)
    assert all(np.hypot(*(np.array(way) - place).T).min() < 2e-3 for place in seen["path"][1:])


def test_places_are_those_when_the_action_takes_effect(hand, tiny_bundle: Path) -> None:
    """Where actions are late the filter looks from where the robot is then, and so does the picture."""
    config = FilterConfig(delay_steps=3)
    late = Monitor.load(tiny_bundle, "always", None, config)
    places = np.array([[0.5, 0.2]])
    observation = hand.observe(places, velocity=(0.8, 0.2), yaw_rate=1.5, goal=places[0])
    seen = Views(late, config).of(
        ActRequest(observation=observation.tolist(), hazards=places.tolist()),
        late.decide(observation, places),
    )
    [x, y, *_] = seen["obstacles"][0]
    assert np.hypot(x - 0.5, y - 0.2) > 0.03
    assert seen["given"] == [[pytest.approx(x, abs=1e-3), pytest.approx(y, abs=1e-3), 0]]
    assert seen["goal"] == pytest.approx([x, y], abs=1e-3)


def test_what_the_lidar_alone_shows_is_told_as_such(hand, monitor: Monitor, views: Views) -> None:
    observation = hand.observe(np.array([[0.6, 0.3]]))
    seen = views.of(ActRequest(observation=observation.tolist()), monitor.decide(observation))
    assert seen["given"] == []
    assert seen["likely"] == [[pytest.approx(0.6, abs=1e-3), pytest.approx(0.3, abs=1e-3), 1]]
    assert seen["heading"] is None
    assert seen["goal"] is None


def test_a_view_of_many_hazards_is_bounded(monitor: Monitor, views: Views) -> None:
    places = np.random.default_rng(0).uniform(-9.0, 9.0, (1000, 2))
    asked = asks(hazards=places.tolist())
    seen = views.of(asked, monitor.decide(asked.observation, places))
    assert len(seen["given"]) == 64
    shown = {row[2] for row in seen["given"]}
    assert shown == set(np.argsort(np.hypot(*places.T))[:64].tolist())


def test_unknown_is_told_as_unknown(monitor: Monitor, views: Views) -> None:
    made = monitor.decide([float("nan")] * 60)
    assert made.mode == Mode.FALLBACK
    row = Robot(asks(), made, 0.001, 0.0).told(0.0)
    assert (row["risk"], row["barrier"], row["since"]["risk"], row["since"]["barrier"]) == (None,) * 4
    seen = views.of(asks(), made)
    assert (seen["nominal"], seen["path"]) == (None, None)
    memory = np.zeros(1, MEMORY)
    memory["planned"] = True
    seen = views.of(asks(), replace(made, memory=memory[0]))
    assert len(seen["path"]) > 1
    far = asks(observation=[1e300] * 60)
    assert "observation[0]" in views.of(far, monitor.decide(far.observation))["problem"]


# --- the files -------------------------------------------------------------------------------------------


class Addresses(HTMLParser):
    """What a page refers to, and what its policy forbids."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        assert tag != "style"
        assert "style" not in given
        assert not [name for name in given if name.startswith("on")]
        assert tag != "script" or given.get("src")
        address = given.get("src") or given.get("href")
        if address and not address.startswith(("data:", "#")):
            self.found.append(address)


def addresses(app: TestClient) -> list[str]:
    parser = Addresses()
    parser.feed(app.get("/").text)
    return parser.found


def test_the_page_and_all_that_it_loads(app: TestClient) -> None:
    page = app.get("/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert page.headers["cache-control"] == "no-cache"
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "unsafe" not in page.headers["content-security-policy"]
    assert app.get("/", headers={"if-none-match": page.headers["etag"]}).status_code == 304
    seen, left = set(), addresses(app)
    while left:
        address = left.pop()
        seen.add(address)
        file = app.get(f"/{address}")
        assert file.status_code == 200
        assert file.headers["x-content-type-options"] == "nosniff"
        assert "immutable" in file.headers["cache-control"]
        kind = {"js": "text/javascript", "css": "text/css"}[address.rpartition(".")[2]]
        assert file.headers["content-type"] == f"{kind}; charset=utf-8"
        folder = address.rpartition("/")[0]
        for name in re.findall(r'^import .* from "\./(.*)";$', file.text, re.MULTILINE):
            left.append(f"{folder}/{name}")
        assert "https://" not in file.text or "uPlot" in address
    shipped = {path.relative_to(PAGE).as_posix() for path in PAGE.rglob("*.[cj]s*")}
    assert {address.split("/", 2)[2] for address in seen} == shipped


def test_other_files_are_not_there(app: TestClient) -> None:
    folder = addresses(app)[0].rpartition("/")[0].removesuffix("/uplot")
    for path in ("/page/0/page.js", f"/{folder}/LICENSE", f"/{folder}/%2e%2e/%2e%2e/live.py", "/page/"):
        assert app.get(path).status_code == 404, path


def test_uplot_is_what_was_published() -> None:
    """As the file beside it says, which also names the version."""
    stated = re.findall(r"^([0-9a-f]{64})  (\S+)$", (PAGE / "uplot" / "VERSION").read_text(), re.MULTILINE)
    assert {name for _, name in stated} == {"uPlot.esm.js", "uPlot.min.css", "LICENSE"}
    for digest, name in stated:
        assert hashlib.sha256((PAGE / "uplot" / name).read_bytes()).hexdigest() == digest


def test_the_files_need_no_key_the_stream_and_an_acknowledgement_do(monitor: Monitor) -> None:
    app = TestClient(create_app(monitor, keys=Keys(act="secret")))
    assert app.get("/").status_code == 200
    assert app.get(f"/{addresses(app)[0]}").status_code == 200
    assert app.get("/live").status_code == 401
    assert needed({"path": "/alarms/latency/acknowledge", "method": "POST"}) == Level.ACT
    assert needed({"path": "/alarms", "method": "GET"}) == Level.READ
    assert app.head("/live", headers={"authorization": "Bearer secret"}).status_code == 200


@pytest.fixture(scope="module")
def service(tiny_bundle: Path) -> Iterator[Service]:
    with Service.start(tiny_bundle, "always") as running:
        yield running


def test_a_service_that_is_watched_answers_and_stops_at_once(service: Service) -> None:
    """A real one: the stream goes on while robots ask, and ends with the service instead of holding it up."""
    body = json.dumps({"observation": [0.25] * 60, "robot": "ada"}).encode()
    with urlopen(f"{service.url}/live?robot=ada", timeout=10.0) as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        urlopen(Request(f"{service.url}/act", body, {"content-type": "application/json"})).read()
        lines = (line.decode() for line in stream)
        update = next(line for line in lines if '"ada"' in line)
        assert json.loads(update.removeprefix("data: "))["looked"] == "ada"
        service.process.send_signal(signal.SIGTERM)
        assert any('"draining"' in line for line in lines)
        assert all(lines)
        assert service.process.wait(20.0) == 0
    assert service.complaints() == ""  # uvicorn would say that it waited for 5 s in vain
