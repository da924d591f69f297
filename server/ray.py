"""The service as a deployment on Ray Serve: replicas on a cluster's nodes, as many as the robots ask for.

    python -m server.ray models/NAME --address auto

The same `POST /act` as `lagnet-serve`. The same command with another bundle changes it, a replica after the
other. Lagnet must be installed on every node; the bundle travels with the deployment.
"""

from __future__ import annotations

import json
import logging
import secrets
import signal
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.types import ASGIApp, Receive, Scope, Send

from command import command, settings
from models import BundleError
from monitor import Monitor, MonitorError
from server.alarms import RULES
from server.app import create_app
from server.crew import Alike
from server.guard import Guard
from server.keeper import KEY_BYTES
from server.keys import Keys
from server.serve import KEY_VARIABLE, ServeConfig, ServeError, read_keys, read_memory_key

NAME = "lagnet"
"""Of the application on the cluster."""
_HERE = frozenset(
    {
        *("bundle", "host", "port", "gate", "threshold", "guide", "max_body", "deadline_ms"),
        *("api_key_file", "read_key_file", "admin_key_file", "max_in_flight", "max_in_flight_all"),
        "memory_key_file",
        *("margin", "position_error", "bearing_error", "travel_error", "delay_steps"),
    }
)
"""What of `lagnet-serve` holds for a replica too; the rest is of its own process or its own connections."""
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class RayConfig(ServeConfig):
    """Serves a bundle on Ray Serve: POST /act, GET /model, /healthz, /readyz.

    When it listens it prints one line of JSON with its url. On a cluster (`--address`) the deployment stays
    and the command ends; without one it serves on this machine until Ctrl-C or SIGTERM.
    """

    address: str | None = None
    """The cluster: "auto", HOST:PORT, or ray://HOST:PORT; by default one on this machine, for as long as the
    command runs."""
    min_replicas: int = 1
    """Fewest replicas; two on two nodes outlive one of them."""
    max_replicas: int = 4
    """Most replicas."""
    ongoing: float = 2.0
    """Requests under way at a replica, on average, beyond which there is one more replica."""
    every_node: bool = True
    """Whether every node listens, or the head alone."""

    def check(self) -> None:
        """Raises ServeError for what cannot be deployed."""
        super().check()
        own = {field.name for field in fields(RayConfig)} - {field.name for field in fields(ServeConfig)}
        for field in fields(ServeConfig):
            if field.name not in _HERE | own and getattr(self, field.name) != field.default:
                flag = f"--{field.name.replace('_', '-')}"
                raise ServeError(f"{flag} is of one process, or Ray's to say: not with Ray")
        if not 1 <= self.min_replicas <= self.max_replicas:
            raise ServeError(
                f"--min-replicas must be 1 to --max-replicas, got {self.min_replicas} and {self.max_replicas}"
            )
        if self.address is not None and self.memory_key_file is None:
            raise ServeError("--memory-key-file: on a cluster those to come must take the memories of now")
        if not self.ongoing > 0.0:
            raise ServeError(f"--ongoing must be above 0, got {self.ongoing}")


class Replicated:
    """A replica's service, which has nothing to do when Ray says that it begins or ends.

    Args:
        guard: the service.
    """

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._lifespan = Starlette()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one connection."""
        app: ASGIApp = self._lifespan if scope["type"] == "lifespan" else self._guard
        await app(scope, receive, send)


def replica(
    files: Mapping[str, bytes], config: RayConfig, keys: Keys, memory_key: bytes
) -> tuple[Monitor, ASGIApp]:
    """What one replica runs: the monitor, warmed up, and the service around it.

    Args:
        files: name → content of the bundle's files.
        config: the settings.
        keys: those that requests must carry one of.
        memory_key: what the replicas seal memories with.
    """
    with tempfile.TemporaryDirectory() as folder:
        bundle = Path(folder) / config.bundle.resolve().name
        bundle.mkdir()
        for name, content in files.items():
            (bundle / name).write_bytes(content)
        monitor = Monitor.load(bundle, config.gate, config.threshold, config.filter_config(), config.guide)
    safety = config.safety()
    # A robot's requests come to any of the replicas.
    safety = replace(safety, freshness=replace(safety.freshness, alone=False))
    guard = create_app(
        monitor, None, keys, config.max_body, safety=safety, memory_key=memory_key, around=Alike
    )
    return monitor, Replicated(guard)


def application(config: RayConfig, keys: Keys, memory_key: bytes) -> Any:
    """The application for `ray.serve.run`.

    Args:
        config: the settings.
        keys: those that requests must carry one of.
        memory_key: what the replicas seal memories with.

    Raises:
        BundleError: if the bundle must not be used; a deployment that runs is left as it is.
        MonitorError: if it cannot be run with these settings.
    """
    from ray import serve

    # Here first: Ray would stop a replica of the old bundle before it finds out that the new one is none.
    Monitor.load(config.bundle, config.gate, config.threshold, config.filter_config(), config.guide)
    files = {path.name: path.read_bytes() for path in config.bundle.iterdir() if path.is_file()}

    class Replica:
        def __init__(self, *orders: Any) -> None:
            self._monitor, self._service = replica(*orders)

        def __serve_build_asgi_app__(self) -> ASGIApp:
            return self._service

        def check_health(self) -> None:
            """Ray starts a replica anew that fails too often by itself."""
            if (faults := self._monitor.faults.internal()) > RULES["faults"].limit:
                raise RuntimeError(f"{faults} internal faults within a minute")

    deployment = serve.deployment(
        name=NAME,
        autoscaling_config={
            "min_replicas": config.min_replicas,
            "max_replicas": config.max_replicas,
            "target_ongoing_requests": config.ongoing,
        },
        ray_actor_options={"num_cpus": 1},
        health_check_period_s=2,
        health_check_timeout_s=10,
    )(serve.ingress()(Replica))
    return deployment.bind(files, config, keys, memory_key)


def deploy(config: RayConfig) -> dict[str, Any]:
    """Puts the service on the cluster that Ray is connected to, or changes the one that is there.

    Returns:
        What to announce.

    Raises:
        ServeError: if it cannot be deployed.
        BundleError, MonitorError: as `application` does.
    """
    from ray import serve

    config.check()
    keys = read_keys(config)
    if not keys.any and config.host not in _LOOPBACK:
        raise ServeError(
            f"{config.host} can be reached from other machines: set {KEY_VARIABLE} or --api-key-file, "
            "or listen on 127.0.0.1"
        )
    memory_key = read_memory_key(config.memory_key_file) or secrets.token_bytes(KEY_BYTES)
    made = application(config, keys, memory_key)
    place = "EveryNode" if config.every_node else "HeadOnly"
    serve.start(proxy_location=place, http_options={"host": config.host, "port": config.port})
    try:
        serve.run(made, name=NAME, route_prefix="/", logging_config={"enable_access_log": False})
    except RuntimeError as error:
        raise ServeError(f"Ray could not deploy it: {error}") from error
    url = f"http://{config.host}:{config.port}"
    return {"event": "listening", "url": url, "host": config.host, "port": config.port}


def main() -> None:
    """Entry point of `python -m server.ray`."""
    with command("server.ray", ServeError, BundleError, MonitorError):
        config = settings(RayConfig, "python -m server.ray")
        config.check()
        try:
            import ray
            from ray import serve
        except ImportError as error:
            raise ServeError(f"Ray Serve is not installed: pip install 'lagnet[fleet]' ({error})") from error
        try:
            ray.init(config.address or "local", log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            raise ServeError(f"no Ray at {config.address or 'this machine'}: {error}") from error
        logging.getLogger("ray.serve").setLevel(logging.WARNING)
        announcement = json.dumps(deploy(config))
        stops = {signal.SIGINT, signal.SIGTERM}
        if config.address is None:
            signal.pthread_sigmask(signal.SIG_BLOCK, stops)
        sys.stdout.write(announcement + "\n")
        sys.stdout.flush()
        if config.address is None:
            signal.sigwait(stops)
            serve.delete(NAME)  # what is under way is answered


if __name__ == "__main__":
    main()
