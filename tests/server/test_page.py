"""The live page in a real browser: headless Chromium, driven by Playwright."""

from __future__ import annotations

import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
import uvicorn
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from evaluation.service import Service
from monitor import Monitor
from pointgoal.vector import PointGoalVectorEnv
from server.app import Lifecycle, create_app
from server.keys import Keys
from server.operation import Operation

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium here: apt-get install chromium")
LAPTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
ACT_KEY = "act"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        # As root, and in containers, Chromium has no sandbox of its own.
        opened = running.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """Opens pages; at the end none of them may have complained, not even about its own policy."""
    complaints: list[str] = []
    contexts = []

    def page_at(url: str, bears: tuple[str, ...] = (), **settings: Any) -> Any:
        context = browser.new_context(**{"viewport": LAPTOP} | settings)
        contexts.append(context)
        page = context.new_page()

        def hear(message: Any) -> None:
            if message.type in ("error", "warning") and not any(word in message.text for word in bears):
                complaints.append(message.text)

        page.on("console", hear)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        return page

    yield page_at
    for context in contexts:
        context.close()
    assert complaints == []


class ByHand(Operation):
    """Alarms by hand, and their acknowledgement with a key of its own."""

    def begin(self) -> None:
        self.state = "ready"
        self.alarms: list[dict[str, Any]] = []
        self.key: str | None = None

    def snapshot(self) -> dict[str, Any]:
        return {"state": self.state, "alarms": self.alarms, "counters": {}, "model": "tiny"}

    def raise_alarm(self, name: str, state: str = "active") -> dict[str, Any]:
        alarm = {"name": name, "state": state, "since": time.time(), "value": 0.3, "limit": 0.1}
        self.alarms.append(alarm | {"acknowledged": False, "cause": "made by hand"})
        return self.alarms[-1]

    def seen(self, path: str, headers: dict[bytes, bytes]) -> int:
        if self.key is not None and headers.get(b"authorization") != f"Bearer {self.key}".encode():
            return 403
        for alarm in self.alarms:
            if alarm["name"] == unquote(path.split("/")[2]):
                alarm["acknowledged"] = True
                return 200
        return 404


class Running:
    """A service in this process, whose operation a test has in hand."""

    def __init__(self, monitor: Monitor, keys: Keys | None = None) -> None:
        self.operation = ByHand(monitor)
        self.operation.begin()
        self._lifecycle = Lifecycle()
        app = create_app(monitor, self._lifecycle, keys, operation=self.operation)

        async def answers(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] == "http" and scope["path"].startswith("/alarms/"):
                status = self.operation.seen(scope["path"], dict(scope["headers"]))
                await JSONResponse({}, status)(scope, receive, send)
            else:
                await app(scope, receive, send)

        listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        settings = uvicorn.Config(answers, log_level="error", lifespan="off", timeout_graceful_shutdown=1)
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [listener]}, daemon=True)
        self._thread.start()

    def act(self, robot: str, key: str | None = None, **more: object) -> dict[str, Any]:
        body = json.dumps({"observation": [0.25] * 60, "robot": robot} | more)
        link = HTTPConnection(urlsplit(self.url).netloc, timeout=10.0)
        link.request("POST", "/act", body, {} if key is None else {"authorization": f"Bearer {key}"})
        reply = link.getresponse()
        assert reply.status == 200
        return json.loads(reply.read())

    def stop(self) -> None:
        for end in self._lifecycle.at_end:
            end()
        self._server.should_exit = True
        self._thread.join(10.0)


@pytest.fixture(scope="module")
def running(monitor: Monitor) -> Iterator[Running]:
    made = Running(monitor)
    yield made
    made.stop()


@pytest.fixture
def service(running: Running) -> Running:
    running.operation.begin()
    return running


@contextmanager
def asking(service: Running, *robots: str) -> Iterator[None]:
    """Robots that ask 20 times a second."""
    done = threading.Event()

    def ask() -> None:
        while not done.wait(0.05):
            for robot in robots:
                service.act(robot)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


class Episode:
    """A robot in MuJoCo that asks a service, whichever stands behind its address, 50 times a second."""

    def __init__(self, url: str, robot: str) -> None:
        self._url, self._robot = url, robot
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._drive)
        self.modes: set[str] = set()

    def __enter__(self) -> Episode:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _drive(self) -> None:
        env = PointGoalVectorEnv(level=1, num_envs=1, num_threads=1)
        observation, _ = env.reset(seed=3)
        link = HTTPConnection(urlsplit(self._url).netloc, timeout=5.0)
        memory, action = None, np.zeros((1, 2))
        while not self._done.wait(0.02):
            body = {"observation": observation[0].tolist(), "memory": memory, "robot": self._robot}
            try:
                link.request("POST", "/act", json.dumps(body))
                reply = json.loads(link.getresponse().read())
                memory, action[0] = reply["memory"], reply["action"]
                self.modes.add(reply["mode"])
            except (OSError, HTTPException):
                link.close()
                action[:] = 0.0
            observation, *_ = env.step(action)
        env.close()


def expect(page: Any, expression: str, seconds: float = 15.0) -> None:
    """Waits until an expression is true in the page, whose policy forbids to evaluate it there."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(30)


def is_live(page: Any, seconds: float = 15.0) -> None:
    expect(page, "document.body.dataset.live === 'true'", seconds)


def ink(page: Any, canvas: str) -> int:
    """How many pixels of a canvas are drawn on."""
    script = """(name) => {
        const canvas = document.querySelector(name);
        const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        return data.filter((value, place) => place % 4 === 3 && value > 0).length;
    }"""
    return int(page.evaluate(script, canvas))


@pytest.mark.long
def test_a_live_episode_and_a_restart_of_the_service(
    opened: Any, tiny_bundle: Path, unused_port: int
) -> None:
    """Real processes: while there is no service nothing looks live, and then it goes on by itself."""
    url = f"http://127.0.0.1:{unused_port}"
    command = [os.sys.executable, "-m", "server.serve", str(tiny_bundle), "--gate", "always"]
    command += ["--port", str(unused_port)]
    with Episode(url, "ada"):
        with Service.run(command) as service:
            page = opened(url, bears=("ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE_CHUNKED_ENCODING"))
            is_live(page)
            page.get_by_role("radio", name="ada").wait_for()
            assert page.locator("#state").text_content() == "ready"
            expect(page, "document.querySelector('#readings dd').textContent.match(/^[0-9.]+$/)")
            expect(page, "document.querySelector('#scene').ariaLabel.includes('in sight, the nearest')")
            before = page.locator("#scene").get_attribute("aria-label")
            assert ink(page, "#scene") > 5000
            assert ink(page, "#risk canvas") > 1000
            expect(page, f"document.querySelector('#scene').ariaLabel !== {json.dumps(before)}")
            service.stop()
            expect(page, "document.body.dataset.live === 'false'")
            assert "Not connected" in page.locator("#banner").text_content()
            assert page.locator("#connection").text_content() == "not connected"
            assert page.locator("#state").text_content() == "unknown"
            faded = "getComputedStyle(document.querySelector('.sight')).opacity"
            assert float(page.evaluate(faded)) < 0.7
            expect(page, "/ [1-9][.0-9]* s old/.test(document.querySelector('#banner').textContent)")
        with Service.run(command):
            is_live(page, 20.0)
            assert page.locator("#banner").is_hidden()
            expect(page, "document.querySelector('.card').dataset.stale === 'false'")
            assert float(page.evaluate(faded)) == 1.0


@pytest.fixture
def unused_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def test_an_alarm_is_shown_told_and_acknowledged(opened: Any, service: Running) -> None:
    page = opened(service.url)
    is_live(page)
    assert page.get_by_text("None.", exact=True).is_visible()
    service.operation.state = "degraded"
    alarm = service.operation.raise_alarm("fallback rate")
    page.get_by_role("button", name="Acknowledge fallback rate").wait_for()
    item = page.locator(".alarm")
    assert "0.300, limit 0.100" in item.text_content()
    assert "made by hand" in item.text_content()
    assert page.locator("#state").text_content() == "degraded"
    expect(page, "document.querySelector('[role=alert]').textContent.includes('Alarm fallback rate: active')")
    page.get_by_role("button", name="Acknowledge fallback rate").press("Enter")
    item.get_by_text("active, acknowledged").wait_for()
    assert alarm["acknowledged"]
    assert page.get_by_role("button", name="Acknowledge fallback rate").is_hidden()
    alarm["state"] = "clear"
    item.wait_for(state="detached")
    assert page.get_by_text("None of 1 raised.").is_visible()


def test_acknowledging_asks_for_the_act_key(opened: Any, service: Running) -> None:
    service.operation.key = ACT_KEY
    alarm = service.operation.raise_alarm("latency", "latched")
    page = opened(service.url, bears=("403",))
    page.get_by_role("button", name="Acknowledge latency").click()
    page.get_by_label("Key", exact=True).fill("wrong")
    page.keyboard.press("Enter")
    page.get_by_label("Key", exact=True).wait_for()
    page.get_by_label("Key", exact=True).fill(ACT_KEY)
    page.keyboard.press("Enter")
    page.get_by_text("latched, acknowledged").wait_for()
    assert alarm["acknowledged"]
    assert ACT_KEY not in page.evaluate("JSON.stringify([{...localStorage}, {...sessionStorage}])")


def test_a_service_with_a_key_is_read_with_it(opened: Any, monitor: Monitor) -> None:
    service = Running(monitor, Keys("secret", ACT_KEY))
    try:
        service.act("ada", key=ACT_KEY)
        page = opened(service.url, bears=("401",))
        page.get_by_role("dialog").wait_for()
        assert page.locator(".card").count() == 0
        page.get_by_label("Key", exact=True).fill("secret")
        page.get_by_role("button", name="Continue").click()
        is_live(page)
        page.get_by_role("radio", name="ada").wait_for()
        page.reload()
        is_live(page)
        assert page.get_by_role("dialog").is_hidden()
        assert "secret" not in page.evaluate("JSON.stringify({...localStorage}) + location.href")
    finally:
        service.stop()


def test_our_page_may_change_what_it_shows_and_anothers_may_not(opened: Any, tiny_bundle: Path) -> None:
    """A post as any page may send it without asking first, to a service without a key."""
    script = (
        "(url) => fetch(url, {method: 'POST', body: '{}', mode: 'no-cors'})"
        ".then((reply) => reply.status).catch(() => 0)"
    )
    with Service.start(tiny_bundle, "always") as service, elsewhere() as other:
        url = f"{service.url}/alarms/latency/acknowledge"
        assert opened(service.url).evaluate(script, url) == 200
        assert 'lagnet_refusals_total{status="403"}' not in scrape(service.url)
        # What is answered it cannot see; the body of what is refused is not read, and the connection closed.
        refused = ("403", "ERR_CONNECTION_RESET")
        assert opened(other, bears=refused).evaluate(script, url) == 0
        assert 'lagnet_refusals_total{status="403"} 1.0' in scrape(service.url)


@contextmanager
def elsewhere() -> Iterator[str]:
    """A page of another site."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def scrape(url: str) -> str:
    with urlopen(f"{url}/metrics", timeout=10.0) as reply:
        return str(reply.read().decode())


def test_robots_are_chosen_by_keyboard(opened: Any, service: Running) -> None:
    with asking(service, "ada", "bert", "cleo"):
        page = opened(service.url)
        page.get_by_role("radio", name="cleo").wait_for()
        expect(page, "document.querySelector('#looked-title').textContent === 'ada'")
        assert page.get_by_role("link", name="Skip to the robot").count() == 1
        chosen = "document.activeElement.value"
        for _ in range(6):
            page.keyboard.press("Tab")
            if page.evaluate(chosen) == "ada":
                break
        assert page.evaluate(chosen) == "ada"
        outline = "getComputedStyle(document.querySelector('.card:has(:checked)')).outlineStyle"
        assert page.evaluate(outline) == "solid"
        page.keyboard.press("ArrowDown")
        expect(page, "document.querySelector('#looked-title').textContent === 'bert'")
        page.keyboard.press("ArrowDown")
        expect(page, "document.querySelector('#looked-title').textContent === 'cleo'")
        expect(page, "document.querySelector('#scene').ariaLabel.includes('speed')")
        assert page.evaluate(chosen) == "cleo"
        assert page.evaluate("document.body.dataset.live") == "true"
        page.reload()
        expect(page, "document.querySelector('#looked-title').textContent === 'cleo'")


def test_a_robot_that_falls_silent_is_greyed_out(opened: Any, service: Running) -> None:
    page = opened(f"{service.url}/#ada")
    with asking(service, "ada", "bert"):
        expect(page, "document.querySelector('#looked').dataset.stale === 'false'")
    with asking(service, "bert"):
        expect(page, "document.querySelector('#looked').dataset.stale === 'true'")
        assert page.locator("#age").text_content().startswith("last heard ")
        card = page.locator(".card", has_text="ada")
        assert "silent for" in card.text_content()
        assert page.evaluate("document.body.dataset.live") == "true"


def test_what_is_unknown_says_so(opened: Any, service: Running) -> None:
    """A memory that is none of ours: the fallback, no risk, no barrier."""
    page = opened(f"{service.url}/#unsure")
    observation = [0.25] * 60
    observation[28:44] = [2.0] * 16
    made = service.act("unsure", observation=observation)
    assert (made["mode"], made["barrier"]) == ("fallback", None)
    page.get_by_role("radio", name="unsure").wait_for()
    expect(page, "document.querySelector('#mode').textContent === 'fallback'")
    readings = page.locator("#readings").text_content()
    assert "Barrierunknown" in readings
    assert "NaN" not in page.locator("body").inner_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [PHONE, LAPTOP], ids=["phone", "laptop"])
def test_layout_and_contrast(opened: Any, service: Running, size: dict[str, int], scheme: str) -> None:
    """Nothing is wider than the screen, targets can be touched, and texts can be read (WCAG AA)."""
    service.operation.raise_alarm("latency")
    service.operation.raise_alarm("novelty", "pending")
    with asking(service, "ada", "a-robot-with-a-name-that-is-quite-long"):
        page = opened(service.url, viewport=size, color_scheme=scheme)
        is_live(page)
        expect(
            page, "document.querySelectorAll('#changes tr').length > 0 && document.querySelector('.alarm')"
        )
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        boxes = page.evaluate(
            "[...document.querySelectorAll('header, .alarms, .robots, main > section')].map((one) => {"
            "const b = one.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })"
        )
        for i, one in enumerate(boxes):
            for other in boxes[i + 1 :]:
                apart = one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
                assert apart, (one, other)
        if size is PHONE:
            button = page.get_by_role("button", name="Acknowledge latency").bounding_box()
            assert button["height"] >= 44
        dark = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 20, 25)"
        assert dark == (scheme == "dark")
        poor = [line for line in page.evaluate(CONTRASTS) if line[1] < 4.5]
        assert poor == []


CONTRASTS = """() => {
    const rgba = (text) => (text.match(/[0-9.]+/g) ?? []).map(Number);
    const light = (c) => c.slice(0, 3).map((v) => v / 255)
        .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
    const behind = (element) => {
        for (let one = element; one; one = one.parentElement) {
            const colour = rgba(getComputedStyle(one).backgroundColor);
            if (colour.length === 3 || colour[3] === 1) return colour;
        }
        return [255, 255, 255];
    };
    const found = [];
    for (const one of document.querySelectorAll('body *')) {
        const own = [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
        if (!own || !one.checkVisibility() || one.closest('.unseen, script, noscript')) continue;
        const pair = [light(rgba(getComputedStyle(one).color)), light(behind(one))].sort((a, b) => b - a);
        found.push([one.textContent.trim().slice(0, 40), (pair[0] + 0.05) / (pair[1] + 0.05)]);
    }
    return found;
}"""


def test_the_switch_goes_before_the_systems_scheme_and_is_remembered(opened: Any, service: Running) -> None:
    page = opened(service.url, color_scheme="light")
    paper = "getComputedStyle(document.body).backgroundColor"
    bright = page.evaluate(paper)
    page.get_by_label("Colours").select_option("dark")
    assert page.evaluate(paper) != bright
    page.reload()
    assert page.evaluate(paper) != bright
    page.get_by_label("Colours").select_option("")
    assert page.evaluate(paper) == bright
    page.emulate_media(color_scheme="dark")
    assert page.evaluate(paper) != bright


def test_the_policy_stops_what_is_not_ours(opened: Any, service: Running) -> None:
    """That the other tests see no violation means something only if one would be seen."""
    page = opened(service.url, bears=("Content Security Policy", "inline"))
    found = page.evaluate(
        """() => new Promise((resolve) => {
            document.addEventListener('securitypolicyviolation', (e) => resolve(e.effectiveDirective));
            const script = document.createElement('script');
            script.textContent = 'window.broken = true';
            document.body.append(script);
        })"""
    )
    assert found.startswith("script-src")
    with suppress(Exception):
        page.evaluate("fetch('http://127.0.0.1:1/')")
    assert page.evaluate("window.broken") is None
