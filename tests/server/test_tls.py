"""HTTPS: the same door, and errors that are clear before anything is loaded."""

from __future__ import annotations

import asyncio
import http.client
import json
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evaluation.service import Service
from server import AsyncClient, Client, ClientError
from server.serve import ServeConfig, ServeError, serve

READ = 0.5
pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="makes its certificate with openssl")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """A certificate and its key."""
    folder = tmp_path_factory.mktemp("tls")
    cert, key = folder / "cert.pem", folder / "key.pem"
    make = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    make += ["-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([*make, "-keyout", str(key), "-out", str(cert)], check=True, capture_output=True)
    return cert, key


@pytest.fixture(scope="module")
def service(tiny_bundle: Path, files) -> Iterator[Service]:
    command = [sys.executable, "-m", "server.serve", str(tiny_bundle), "--port", "0", "--drain-seconds", "0"]
    command += ["--tls-cert", str(files[0]), "--tls-key", str(files[1]), "--read-seconds", str(READ)]
    with Service.run(command) as running:
        yield running


def test_decisions_over_tls(service: Service, files, observation) -> None:
    assert service.url.startswith("https://127.0.0.1:")
    port = int(service.url.rsplit(":", 1)[1])
    trusted = ssl.create_default_context(cafile=str(files[0]))
    link = http.client.HTTPSConnection("127.0.0.1", port, context=trusted, timeout=10.0)
    for request in range(50):
        link.request("POST", "/act", json.dumps({"observation": observation, "request": request}))
        reply = link.getresponse()
        assert json.loads(reply.read())["request"] == request
    plain = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
    plain.request("GET", "/healthz")
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        plain.getresponse()
    assert service.complaints() == ""


def test_who_is_silent_or_slow_over_tls_is_closed_in_time(service: Service, files) -> None:
    port = int(service.url.rsplit(":", 1)[1])
    trusted = ssl.create_default_context(cafile=str(files[0]))

    def connect() -> socket.socket:
        return socket.create_connection(("127.0.0.1", port), timeout=10.0)

    def greeted() -> socket.socket:
        return trusted.wrap_socket(connect(), server_hostname="127.0.0.1")

    begun, silent, mute = greeted(), greeted(), connect()
    begun.sendall(b"POST /act HTTP/1.1\r\nhost: x\r\ncontent-length: 1000\r\n\r\n{")
    started = time.monotonic()
    assert begun.recv(1000).startswith(b"HTTP/1.1 408 ")
    assert silent.recv(1000) == b""
    # One that never says hello.
    assert mute.recv(1000) == b""
    assert time.monotonic() - started < 3.0 * READ + 1.0
    for link in (begun, silent, mute):
        link.close()


@pytest.mark.parametrize(
    ("cert", "key", "why"),
    [
        ("cert.pem", None, "go together"),
        (None, "key.pem", "go together"),
        ("none.pem", "key.pem", "--tls-cert .*none.pem cannot be read"),
        ("cert.pem", "none.pem", "--tls-key .*none.pem cannot be read"),
        ("key.pem", "key.pem", "no certificate and its key"),
        ("cert.pem", "cert.pem", "no certificate and its key"),
        ("cert.pem", "other.pem", "no certificate and its key"),
        ("cert.pem", "locked.pem", "no certificate and its key"),
    ],
)
def test_files_that_are_no_certificate_and_its_key(files, cert, key, why) -> None:
    folder = files[0].parent
    new = ["openssl", "genpkey", "-algorithm", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    subprocess.run([*new, "-out", str(folder / "other.pem")], check=True, capture_output=True)
    lock = ["openssl", "pkcs8", "-topk8", "-in", str(files[1]), "-passout", "pass:sesame"]
    subprocess.run([*lock, "-out", str(folder / "locked.pem")], check=True, capture_output=True)
    given = {name: folder / file for name, file in (("tls_cert", cert), ("tls_key", key)) if file}
    with pytest.raises(ServeError, match=why):
        serve(ServeConfig(Path("/none"), **given))


@pytest.mark.parametrize("scheme", ["https", "wss"])
def test_a_client_verifies_and_is_decided_about(service: Service, files, observation, scheme) -> None:
    url, memory = service.url.replace("https", scheme), None
    with Client(url, timeout=5.0, ca_file=files[0], robot="ada") as client:
        for _ in range(20):
            decision = client.decide(observation, memory=memory)
            assert decision.reason is None
            memory = decision.memory
        assert not client.faults.counts
    # Whoever signed it is not known to the system.
    with pytest.raises(ClientError, match="certificate verify failed"):
        Client(url, timeout=5.0)


def test_an_async_client_verifies_as_well(service: Service, files, observation) -> None:
    async def run() -> None:
        async with AsyncClient(service.url, timeout=5.0, ca_file=files[0]) as client:
            assert (await client.decide(observation)).reason is None
        with pytest.raises(ClientError, match="certificate verify failed"):
            async with AsyncClient(service.url, timeout=5.0):
                pass

    asyncio.run(run())
