"""`lagnet-serve` as it is typed: start, orderly stop, and what it refuses."""

from __future__ import annotations

import http.client
import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from evaluation.service import Service, end_with_parent
from models import BundleError
from monitor import MonitorError
from server import Client
from server.serve import ServeConfig, ServeError, read_api_key, serve

COMMAND = [sys.executable, "-m", "server.serve"]


def test_what_cannot_be_served_is_one_clear_line(tiny_bundle: Path) -> None:
    result = subprocess.run(
        [*COMMAND, str(tiny_bundle), "--host", "0.0.0.0", "--port", "0"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (result.returncode, result.stdout) == (2, "")
    (line,) = result.stderr.strip().splitlines()
    assert "LAGNET_API_KEY" in line


@pytest.mark.parametrize(
    ("settings", "error", "named"),
    [
        ({"bundle": Path("/none")}, BundleError, "no such bundle"),
        ({"threshold": float("nan")}, MonitorError, "threshold"),
        ({"port": 70000}, ServeError, "--port"),
        ({"max_body": 0}, ServeError, "--max-body"),
        ({"drain_seconds": -1.0}, ServeError, "--drain-seconds"),
        ({"drain_seconds": float("nan")}, ServeError, "--drain-seconds"),
        ({"host": "::"}, ServeError, "LAGNET_API_KEY"),
        ({"host": "no such host"}, ServeError, "no such host"),
        ({"host": "a" * 70}, ServeError, "cannot listen"),
        ({"api_key_file": Path("/none")}, ServeError, "/none"),
    ],
)
def test_settings_that_cannot_be_served(tiny_bundle: Path, settings, error, named) -> None:
    with pytest.raises(error, match=named):
        serve(ServeConfig(**({"bundle": tiny_bundle, "port": 0} | settings)))


def test_a_port_that_is_taken_is_named(tiny_bundle: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ServeError, match=f"cannot listen on 127.0.0.1:{port}"):
            serve(ServeConfig(tiny_bundle, port=port))


@pytest.mark.parametrize("key", ["", " ", "two words", "schl\u00fcssel", "tab\there"])
def test_a_key_that_no_header_can_carry_is_refused(key: str, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "key").write_text(key)
    with pytest.raises(ServeError, match="API key"):
        read_api_key(tmp_path / "key")
    monkeypatch.setenv("LAGNET_API_KEY", key)
    with pytest.raises(ServeError, match="API key"):
        read_api_key(None)


def test_the_key_comes_from_the_file_or_the_environment(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("LAGNET_API_KEY", raising=False)
    assert read_api_key(None) is None
    monkeypatch.setenv("LAGNET_API_KEY", "one")
    assert read_api_key(None) == "one"
    (tmp_path / "key").write_text("two\n")
    assert read_api_key(tmp_path / "key") == "two"


def test_a_stop_says_not_ready_first_and_finishes_what_is_in_flight(tiny_bundle: Path, observation) -> None:
    command = [*COMMAND, str(tiny_bundle), "--port", "0", "--gate", "risk", "--guide", "off"]
    command += ["--drain-seconds", "1.0"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=end_with_parent,  # noqa: PLW1509
    )
    try:
        assert select.select([process.stdout], [], [], 60.0)[0]
        said = json.loads(process.stdout.readline())
        assert said["event"] == "listening"
        assert (said["gate"], said["guide"]) == ("risk", "off")
        assert said["url"] == f"http://127.0.0.1:{said['port']}"
        link = http.client.HTTPConnection("127.0.0.1", said["port"])
        # A request of which only the head has arrived when the stop is asked for.
        body = json.dumps({"observation": observation}).encode()
        slow = socket.create_connection(("127.0.0.1", said["port"]), timeout=20.0)
        # One that hangs up in the middle of its body: no reply, and no word in the log.
        with socket.create_connection(("127.0.0.1", said["port"])) as gone:
            gone.sendall(b"POST /act HTTP/1.1\r\nhost: x\r\ncontent-length: 100\r\n\r\n{")
        slow.sendall(f"POST /act HTTP/1.1\r\nhost: x\r\ncontent-length: {len(body)}\r\n\r\n".encode())
        link.request("GET", "/readyz")
        assert link.getresponse().read() == b'{"status":"ready"}'
        process.send_signal(signal.SIGTERM)
        time.sleep(0.2)
        link.request("GET", "/readyz")
        reply = link.getresponse()
        assert (reply.status, reply.read()) == (503, b'{"status":"draining"}')
        with Client(said["url"], timeout=5.0) as client:
            assert client.model().model == said["model"]
            assert client.decide(observation).reason is None
        threading.Timer(1.2, slow.sendall, (body,)).start()
        assert b"200 OK" in slow.recv(65536)
        assert process.wait(10.0) == 0
        assert process.stderr.read() == ""
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_without_a_word(tiny_bundle: Path, number: signal.Signals) -> None:
    service = Service.start(tiny_bundle, "off")
    service.process.send_signal(number)
    assert service.process.wait(10.0) == 0
    assert service.complaints() == ""


def test_beyond_loopback_it_serves_with_the_key_from_a_file(tiny_bundle: Path, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text("sesame\n")
    command = [*COMMAND, str(tiny_bundle), "--port", "0", "--host", "0.0.0.0", "--api-key-file", str(key)]
    with Service.run(command) as service:
        url = service.url.replace("0.0.0.0", "127.0.0.1")
        with Client(url, api_key="sesame") as client:
            assert client.model().level == 1
        link = http.client.HTTPConnection("127.0.0.1", int(url.rsplit(":", 1)[1]))
        link.request("GET", "/model")
        assert link.getresponse().status == 401
