"""What lies in `deploy/` is true: its flags, paths and metrics exist, and the tools that read it take it."""

from __future__ import annotations

import http.client
import json
import re
import shlex
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml
from fastapi.testclient import TestClient

from evaluation.service import Service
from monitor import Monitor
from recorder import Recorder, Settings
from server import Client
from server.app import create_app
from server.crew import Crew
from server.keys import Keys
from server.schema import ModelReply
from server.serve import ServeConfig
from tests.test_rooms import PROJECT

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
OBJECTS = {each["kind"]: each for each in yaml.safe_load_all((DEPLOY / "kubernetes.yaml").read_text())}
POD = OBJECTS["Deployment"]["spec"]["template"]["spec"]
[CONTAINER] = POD["containers"]
DOCKERFILE = (DEPLOY / "Dockerfile").read_text()
UNIT = (DEPLOY / "lagnet.service").read_text()

CERTIFICATE = (
    "openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=localhost "
    "-addext subjectAltName=DNS:localhost -keyout tls.key -out tls.crt"
)


def needs(tool: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not installed")


def typed(words: list[str]) -> ServeConfig:
    """The settings, as the command reads them."""
    return tyro.cli(ServeConfig, args=words)


def test_every_way_to_start_it_has_flags_that_exist_and_a_key_beyond_loopback() -> None:
    [start] = re.findall(r"^ExecStart=(.*)$", UNIT, re.M)
    unit = typed(shlex.split(start)[1:])
    assert (unit.workers, unit.host, unit.api_key_file) == (2, "127.0.0.1", Path("%d/api-key"))
    [command] = re.findall(r"^CMD (\[.*\])$", DOCKERFILE, re.M)
    assert typed(json.loads(command)).host == "0.0.0.0"
    pod = typed(CONTAINER["args"])
    assert pod.host == "0.0.0.0"
    [keys] = [mount for mount in CONTAINER["volumeMounts"] if mount["name"] == "keys"]
    assert pod.api_key_file == Path(keys["mountPath"]) / "api-key"
    assert POD["terminationGracePeriodSeconds"] > pod.drain_seconds + 10


def test_probes_ask_what_is_answered_without_a_key(monitor: Monitor) -> None:
    service = TestClient(create_app(monitor, keys=Keys(act="sesame")))
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert service.get(CONTAINER[probe]["httpGet"]["path"]).status_code == 200
    assert service.get("/model").status_code == 401


def test_what_belongs_together_in_the_cluster_does() -> None:
    labels = OBJECTS["Deployment"]["spec"]["template"]["metadata"]["labels"]
    for selector in (
        OBJECTS["Service"]["spec"]["selector"],
        OBJECTS["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"],
        OBJECTS["Deployment"]["spec"]["selector"]["matchLabels"],
    ):
        assert selector == labels
    assert OBJECTS["PodDisruptionBudget"]["spec"]["minAvailable"] < OBJECTS["Deployment"]["spec"]["replicas"]
    assert OBJECTS["Deployment"]["spec"]["strategy"]["rollingUpdate"]["maxUnavailable"] == 0
    volumes = {volume["name"] for volume in POD["volumes"]}
    assert {mount["name"] for mount in CONTAINER["volumeMounts"]} == volumes


def test_containers_run_as_nobody_and_write_nowhere_else() -> None:
    assert POD["securityContext"]["runAsNonRoot"]
    security = CONTAINER["securityContext"]
    assert security["readOnlyRootFilesystem"]
    assert not security["allowPrivilegeEscalation"]
    assert security["capabilities"] == {"drop": ["ALL"]}
    user = str(POD["securityContext"]["runAsUser"])
    assert re.findall(r"^USER (.*)$", DOCKERFILE, re.M) == [f"{user}:{user}"]
    # Where the filter's machine code goes, in all three.
    cache = "/var/cache/lagnet"
    assert f"NUMBA_CACHE_DIR={cache}" in DOCKERFILE
    assert f"NUMBA_CACHE_DIR={cache}" in UNIT
    assert cache in {mount["mountPath"] for mount in CONTAINER["volumeMounts"]}


def test_an_image_is_made_of_the_runtime_and_nothing_else() -> None:
    lines = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    let_in = {line[1:] for line in lines if line.startswith("!")}
    packages = set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    assert let_in == packages | {"pyproject.toml", "constraints.txt", "README.md", "LICENSE"}
    assert "constraints.txt .\n" in DOCKERFILE.replace(" \\", "")  # no extra


@needs("systemd-analyze")
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / "lagnet.service"
    unit.write_text(UNIT.replace("/usr/local/lib/lagnet/bin/lagnet-serve", sys.executable))
    result = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


@needs("promtool")
def test_prometheus_takes_the_rules() -> None:
    command = ["promtool", "check", "rules", DEPLOY / "prometheus-rules.yaml"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def expressions() -> Iterator[str]:
    for group in yaml.safe_load((DEPLOY / "prometheus-rules.yaml").read_text())["groups"]:
        yield from (rule["expr"] for rule in group["rules"])
    dashboard = json.loads((DEPLOY / "grafana.json").read_text())
    for panel in dashboard["panels"]:
        yield from (target["expr"] for target in panel["targets"])
    yield from (each["query"]["query"] for each in dashboard["templating"]["list"] if each["type"] == "query")


def exposed(text: str) -> set[str]:
    """The names of the samples that a text of metrics may have."""
    names = set()
    for name, kind in re.findall(r"^# TYPE (\S+) (\S+)$", text, re.M):
        names |= {name + end for end in ("_bucket", "_sum", "_count")} if kind == "histogram" else {name}
    return names


def test_every_metric_that_is_asked_for_is_there(monitor: Monitor, tmp_path: Path) -> None:
    settings = Settings(None, 0, 0, str(tmp_path), 16_000_000)
    with Recorder(settings, ModelReply.of(monitor).model_dump(), {}) as recorder:
        crew = Crew(1, [tmp_path / "1"])
        reply = TestClient(create_app(monitor, recorder=recorder, around=crew.around)).get("/metrics")
    assert reply.status_code == 200
    asked = {name for expression in expressions() for name in re.findall(r"\blagnet_\w+", expression)}
    recorded = {
        rule["record"].split(":")[1]
        for group in yaml.safe_load((DEPLOY / "prometheus-rules.yaml").read_text())["groups"]
        for rule in group["rules"]
        if "record" in rule
    }
    assert asked - recorded <= exposed(reply.text)


def test_the_dashboards_panels_do_not_lie_on_one_another() -> None:
    panels = json.loads((DEPLOY / "grafana.json").read_text())["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken: set[tuple[int, int]] = set()
    for panel in panels:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken
        assert place["x"] + place["w"] <= 24
        taken |= cells


@contextmanager
def nginx_before(service: Service, folder: Path) -> Iterator[int]:
    """nginx with our settings, on a port of its own and with a certificate for a day."""
    subprocess.run(
        shlex.split(CERTIFICATE),
        cwd=folder,
        capture_output=True,
        check=True,
    )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    settings = (DEPLOY / "nginx.conf").read_text()
    for ours, there in (
        ("127.0.0.1:8000", service.url.removeprefix("http://")),
        ("listen 8443", f"listen 127.0.0.1:{port}"),
        ("/etc/lagnet", str(folder)),
    ):
        assert ours in settings
        settings = settings.replace(ours, there)
    temporary = "".join(
        f"{name}_temp_path {folder}/{name};" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    whole = f"daemon off; pid {folder}/pid; events {{}} http {{ {temporary} {settings} }}"
    (folder / "nginx.conf").write_text(whole)
    command = ["nginx", "-e", folder / "log", "-c", folder / "nginx.conf"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 20.0
        while True:
            assert process.poll() is None, process.communicate()[1]
            assert time.monotonic() < deadline
            with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                break
            time.sleep(0.02)
        yield port
    finally:
        process.terminate()
        process.wait()


@needs("nginx")
@needs("openssl")
def test_nginx_hands_a_robots_requests_on_over_one_connection(
    tiny_bundle: Path, observation: list[float], tmp_path: Path
) -> None:
    with Service.start(tiny_bundle, "always") as service, nginx_before(service, tmp_path) as port:
        context = ssl.create_default_context(cafile=tmp_path / "tls.crt")
        link = http.client.HTTPSConnection("localhost", port, context=context, timeout=10.0)
        first: Any = None
        for _ in range(3):
            link.request("POST", "/act", json.dumps({"observation": observation}))
            reply = link.getresponse()
            assert (reply.status, json.loads(reply.read())["gate"]) == (200, "always")
            first = first or link.sock
            assert link.sock is first
        link.close()


@needs("nginx")
@needs("openssl")
def test_through_nginx_robots_stream_and_the_page_is_of_the_same_site(
    tiny_bundle: Path, observation: list[float], tmp_path: Path
) -> None:
    with Service.start(tiny_bundle, "always") as service, nginx_before(service, tmp_path) as port:
        certificate = tmp_path / "tls.crt"
        with Client(f"wss://localhost:{port}", timeout=5.0, ca_file=certificate) as robot:
            memory = None
            for _ in range(3):
                decision = robot.decide(observation, memory=memory)
                assert (decision.opened_by, decision.reason) == ("always", None)
                memory = decision.memory
            assert not robot.faults.counts
        context = ssl.create_default_context(cafile=certificate)
        link = http.client.HTTPSConnection("localhost", port, context=context, timeout=10.0)
        path = "/alarms/latency/acknowledge"
        for origin, status in ((f"https://localhost:{port}", 200), ("https://localhost", 403)):
            link.request("POST", path, "{}", {"origin": origin})
            reply = link.getresponse()
            reply.read()
            assert reply.status == status, origin
        link.request("GET", "/live")
        assert link.getresponse().readline() == b"event: about\n"
        link.close()
