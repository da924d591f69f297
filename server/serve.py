"""The command `lagnet-serve`."""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import json
import math
import os
import socket
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import tyro
import uvicorn

from command import command, settings, why_not_folder
from filter import FilterConfig
from models import BundleError
from monitor import DEFAULT_STRENGTH, GateName, Monitor, MonitorError, Strength
from recorder import Recorder, RecordingError, Settings
from server.app import MAX_BODY, Lifecycle, create_app
from server.crew import Crew
from server.door import Connection, Door, Patience
from server.guard import Guard
from server.schema import ModelReply

KEY_VARIABLE = "LAGNET_API_KEY"
"""Environment variable that may hold the key."""
_OTHER_FILES = 64
"""Files that are open beside the connections."""
LEAST_FILE = 4.0
"""Size that a file may at least have [MB]: the largest batch fits."""
_LAST_WORDS = 5
"""How long requests in flight may take once the service has closed its door [s]."""


class ServeError(ValueError):
    """A service that must not be started as asked."""


@dataclass(frozen=True)
class ServeConfig:
    """Serves a bundle: POST /act, GET /model, /healthz, /readyz.

    When it listens it prints one line of JSON with its url. Ctrl-C or SIGTERM lets it finish what is in
    flight; a second one stops it at once.
    """

    bundle: Annotated[Path, tyro.conf.Positional]
    """The bundle's folder, for example models/NAME."""
    host: str = "127.0.0.1"
    """Address to listen on. Beyond loopback a key is required."""
    port: int = 8000
    """Port to listen on; 0 takes a free one."""
    workers: int = 1
    """Processes behind the one address; one that dies is started again. What is told by each, /metrics for
    example, is told of all; limits are each worker's, room for recordings is shared out among them."""
    gate: GateName = "risk"
    """When the filter is active: where the risk score or the barrier asks for it, always, never."""
    threshold: float | None = None
    """Risk score above which the gate `risk` activates the filter; by default the bundle's."""
    guide: Strength = DEFAULT_STRENGTH
    """How much the guide may do: nothing, lead on from a refused action on, or lead ahead."""
    margin: float = FilterConfig.margin
    """What the filter keeps from a hazard's edge for what its model leaves out [m]."""
    position_error: float = 0.0
    """Bound on the error of a hazard's measured distance [m]."""
    bearing_error: float = 0.0
    """Bound on the error of its bearing [rad]."""
    travel_error: float = 0.0
    """Bound on how far the robot strays from the filter's model, as a share of its way."""
    delay_steps: int = 0
    """How old observations are and how late actions take effect, together, in control steps."""
    api_key_file: Path | None = None
    """File that holds the key; otherwise the environment variable LAGNET_API_KEY."""
    max_body: int = MAX_BODY
    """Most bytes of a request's body; more is refused with 413."""
    max_connections: int = 512
    """Most robots' connections; where there are more, the one that was idle longest is closed, and while none
    is idle, further ones are answered 503. As many again may have asked for nothing yet."""
    read_seconds: float = 5.0
    """How long a new connection may be silent, a request may take to arrive, and a reply to be taken [s]."""
    idle_seconds: float = 75.0
    """How long a connection may be silent between two requests [s]."""
    drain_seconds: float = 0.5
    """How long /readyz says 503 before the service stops accepting connections [s]."""
    record: Path | None = None
    """Folder in which every decision is recorded with its input (MCAP), and every incident."""
    record_mb: float = 4096.0
    """Size of all recordings in it [MB]; where they come to more, the oldest go."""
    record_file_mb: float = 64.0
    """Size of one recording [MB]; then the next one begins."""
    incidents: Path | None = None
    """Folder for the last 30 s before every fallback or alarm; by default that of --record."""
    incidents_mb: float = 256.0
    """Size of all files of incidents in it [MB]; where they come to more, the oldest go."""

    def filter_config(self) -> FilterConfig:
        """The filter's settings, or ServeError for one that is out of its range."""
        names = ("margin", "position_error", "bearing_error", "travel_error", "delay_steps")
        try:
            return FilterConfig(**{name: getattr(self, name) for name in names})
        except ValueError as error:
            name, _, rest = str(error).partition(" ")
            raise ServeError(f"--{name.replace('_', '-')} {rest}") from error

    def check(self) -> None:
        """Raises ServeError for what no service can be started with."""
        self.filter_config()
        if not 0 <= self.port <= 65535:
            raise ServeError(f"--port must be 0 to 65535, got {self.port}")
        if self.workers < 1:
            raise ServeError(f"--workers must be at least 1, got {self.workers}")
        if self.max_body < 1 or self.max_connections < 1:
            raise ServeError("--max-body and --max-connections must be at least 1")
        for flag, seconds in (("--read-seconds", self.read_seconds), ("--idle-seconds", self.idle_seconds)):
            if not (math.isfinite(seconds) and seconds > 0.0):
                raise ServeError(f"{flag} must be finite and above 0, got {seconds}")
        if not (math.isfinite(self.drain_seconds) and self.drain_seconds >= 0.0):
            raise ServeError(f"--drain-seconds must be finite and at least 0, got {self.drain_seconds}")
        self._check_recording()

    def _check_recording(self) -> None:
        sizes = (
            ("--record-file-mb", self.record_file_mb, LEAST_FILE),
            ("--record-mb", self.record_mb, 2.0 * self.record_file_mb * self.workers),
            ("--incidents-mb", self.incidents_mb, 4.0 * LEAST_FILE * self.workers),
        )
        for flag, size, least in sizes:
            if not (math.isfinite(size) and size >= least):
                raise ServeError(f"{flag} must be finite and at least {least:g}, got {size}")
        for flag, folder in (("--record", self.record), ("--incidents", self.incidents)):
            if folder is not None and (why := why_not_folder(folder)) is not None:
                raise ServeError(f"{flag} {folder} {why}")

    def recording(self) -> Settings | None:
        """What is recorded where; None if nothing is."""
        incidents = self.record if self.incidents is None else self.incidents
        if incidents is None:
            return None
        return Settings(
            record=None if self.record is None else str(self.record),
            record_bytes=int(self.record_mb * 1e6),
            file_bytes=int(self.record_file_mb * 1e6),
            incidents=str(incidents),
            incidents_bytes=int(self.incidents_mb * 1e6),
        )


class DrainingServer(uvicorn.Server):
    """A uvicorn server that announces itself, and says "not ready" for a while before it stops.

    Args:
        config: uvicorn's settings.
        lifecycle: shared with the app.
        drain_seconds: how long it says so [s].
        announcement: a line for stdout, written once it listens and stops in order when told to.
        door: who may stay connected.
        crew: the workers that it is one of.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        lifecycle: Lifecycle,
        drain_seconds: float,
        announcement: str,
        door: Door,
        crew: Crew | None = None,
    ) -> None:
        super().__init__(config)
        self._crew = crew
        self.server_state = self._door = door
        self._lifecycle = lifecycle
        self._drain_seconds = drain_seconds
        self._announcement = announcement
        self._stop_at: float | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts to listen, and says so."""
        if self._crew is not None:
            await self._crew.start()
        await super().startup(sockets)
        sys.stdout.write(self._announcement + "\n")
        sys.stdout.flush()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """First signal: drain; second: stop at once. Neither is raised again after the shutdown."""
        if self._stop_at is not None:
            self.should_exit = self.force_exit = True
        self._lifecycle.draining = True
        self._stop_at = time.monotonic() + self._drain_seconds

    async def on_tick(self, counter: int) -> bool:
        """Asked ten times a second whether to stop."""
        self._door.sweep(asyncio.get_running_loop().time())
        if self._stop_at is not None and time.monotonic() >= self._stop_at:
            self.should_exit = True
        return await super().on_tick(counter)


def listen(host: str, port: int, api_key: str | None) -> socket.socket:
    """Opens the listening socket.

    Raises:
        ServeError: if the address cannot be had, or lies beyond loopback and there is no key.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        if api_key is None and not ipaddress.ip_address(address[0]).is_loopback:
            raise ServeError(
                f"{host} can be reached from other machines: set {KEY_VARIABLE} or --api-key-file, "
                "or listen on 127.0.0.1"
            )
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except (OSError, UnicodeError) as error:  # UnicodeError: a host name that cannot be one
        what = getattr(error, "strerror", None) or error
        raise ServeError(f"cannot listen on {host}:{port}: {what}") from error
    return listener


def read_api_key(path: Path | None) -> str | None:
    """The key from a file, else from the environment, else None.

    Raises:
        ServeError: if the file cannot be read, or the key is empty or not printable ASCII.
    """
    try:
        key = os.environ.get(KEY_VARIABLE) if path is None else path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServeError(f"--api-key-file {path}: cannot be read: {error}") from error
    if key is None:
        return None
    if not key or not all("!" <= letter <= "~" for letter in key):
        raise ServeError("the API key must be printable ASCII without spaces, and not empty")
    return key


def allow_files(connections: int) -> None:
    """Allows this process as many open files as so many robots and newcomers take.

    Raises:
        ServeError: if the system does not.
    """
    if sys.platform == "win32":
        return
    import resource

    wanted = 2 * connections + _OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise ServeError(
            f"--max-connections {connections} takes {wanted} open files, {hard} are allowed (ulimit -n)"
        )
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def serve(config: ServeConfig, crew: Crew | None = None, listener: socket.socket | None = None) -> None:
    """Serves until told to stop.

    Args:
        config: the settings.
        crew: the workers that this process is one of.
        listener: the listening socket, if there is one already.

    Raises:
        ServeError: for settings or an address that cannot be had.
        BundleError: if the bundle must not be used.
        MonitorError: if it cannot be run with these settings.
        RecordingError: if it cannot be recorded.
    """
    config.check()
    api_key = read_api_key(config.api_key_file)
    allow_files(config.max_connections)
    listener = listener or listen(config.host, config.port, api_key)
    if config.workers > 1:
        from server.workers import supervise

        supervise(config, listener)
        return
    with listener:
        monitor = Monitor.load(
            config.bundle, config.gate, config.threshold, config.filter_config(), config.guide
        )
        lifecycle = Lifecycle()
        host, port = listener.getsockname()[:2]
        url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
        ready = {"event": "listening", "url": url, "host": host, "port": port, "model": monitor.bundle.id}
        gate = {"gate": monitor.gate.name, "threshold": monitor.gate.threshold, "guide": config.guide}
        announcement = json.dumps(ready | gate)
        with recorder_of(config, monitor) as recorder:
            app = create_app(
                monitor, lifecycle, api_key, config.max_body, recorder, crew.around if crew else None
            )
            # What is loaded stays: looking through it again and again for garbage would hold up decisions.
            gc.collect()
            gc.freeze()
            _server(app, lifecycle, config, announcement, crew).run(sockets=[listener])


def recorder_of(config: ServeConfig, monitor: Monitor) -> AbstractContextManager[Recorder | None]:
    """What records, until its context ends; nothing where nothing is to be recorded.

    Raises:
        RecordingError: if it cannot start.
    """
    wanted = config.recording()
    if wanted is None:
        return nullcontext()
    return Recorder(wanted, ModelReply.of(monitor).model_dump(), asdict(config.filter_config()))


def _server(
    app: Guard, lifecycle: Lifecycle, config: ServeConfig, announcement: str, crew: Crew | None
) -> DrainingServer:
    settings = uvicorn.Config(
        app,
        access_log=False,
        log_level="error",  # warnings are of what anybody may send, a line each
        lifespan="off",
        ws="none",
        server_header=False,
        http=Connection,
        timeout_keep_alive=math.ceil(config.idle_seconds),
        timeout_graceful_shutdown=_LAST_WORDS,
    )
    patience = Patience(config.read_seconds, config.idle_seconds, config.max_connections)
    door = Door(patience, app.is_robots)
    return DrainingServer(settings, lifecycle, config.drain_seconds, announcement, door, crew)


def main() -> None:
    """Entry point of `lagnet-serve`: exit status 0 after an orderly stop, 2 if it could not start."""
    with command("lagnet-serve", ServeError, BundleError, MonitorError, RecordingError):
        serve(settings(ServeConfig, "lagnet-serve"))


if __name__ == "__main__":
    main()
