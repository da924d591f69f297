"""The command `lagnet-serve`."""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import json
import math
import os
import signal
import socket
import ssl
import sys
import time
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, NamedTuple

import tyro
import uvicorn

from command import command, settings, why_not_folder
from filter import FilterConfig
from models import BundleError
from monitor import DEFAULT_STRENGTH, GateName, Monitor, MonitorError, Strength
from recorder import Recorder, RecordingError, Settings
from server.alarms import AlarmsError, read_rules
from server.app import MAX_BODY, Lifecycle, create_app
from server.change import ChangeError, Changer
from server.crew import Crew
from server.door import Connection, Door, Patience
from server.events import Events, Form
from server.freshness import Freshness, Limits
from server.guard import Guard
from server.keeper import KEY_BYTES
from server.keys import Keys
from server.operation import Operation
from server.safety import Safety
from server.schema import ModelReply
from server.streaming import StreamConnection

KEY_VARIABLE = "LAGNET_API_KEY"
"""Environment variable that may hold the key to ask for decisions."""
READ_KEY_VARIABLE = "LAGNET_READ_KEY"
"""Environment variable that may hold the key to read."""
ADMIN_KEY_VARIABLE = "LAGNET_ADMIN_KEY"
"""Environment variable that may hold the key to change things."""
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
    """Serves a bundle: POST /act, GET /model, /healthz, /readyz, and a live page at /.

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
    """File that holds the key to ask for decisions; otherwise the environment variable LAGNET_API_KEY."""
    memory_key_file: Path | None = None
    """File with at least 32 bytes by which robots' memories are sealed: services that share it take each
    other's, and a restart loses none. By default a key made at random."""
    read_key_file: Path | None = None
    """File that holds the key to read alone; otherwise the environment variable LAGNET_READ_KEY."""
    admin_key_file: Path | None = None
    """File that holds the key to change things; otherwise the environment variable LAGNET_ADMIN_KEY."""
    tls_cert: Path | None = None
    """File with the certificate (PEM, with those above it): then it speaks HTTPS."""
    tls_key: Path | None = None
    """File with the certificate's key (PEM, no passphrase)."""
    deadline_ms: float | None = None
    """How long a decision may take [ms]; then the fallback is sent. Decisions then take about 0.05 ms longer.
    By default each takes as long as it takes."""
    max_age_ms: float | None = None
    """How old an observation may be, by its stamp [ms]; then, and where it has no stamp or no robot's name,
    the fallback is sent. By default only the clocks of those that are stamped are checked."""
    hold_after_ms: float = 1e3 * Limits.hold_after
    """For how long a robot may be without a fresh observation [ms]; then it is held until it is reset."""
    silent_after_ms: float = 1e3 * Limits.silent_after
    """After what time without a request a robot counts as silent [ms]."""
    max_in_flight: int = Safety.max_in_flight
    """Most requests of one client address that await their decisions; more are answered 503."""
    max_in_flight_all: int = Safety.max_in_flight_all
    """Most requests of all clients together that await their decisions."""
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
    alarms: Path | None = None
    """TOML file with settings of alarms that are to be other than usual."""
    log: Form = "text"
    """How events are told on standard error: warnings and errors as text, or all of them as JSON, a line
    each."""
    bundles: Path | None = None
    """Folder with other bundles, which POST /model may change to. SIGHUP loads the service's own anew."""

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
        if self.workers > 1 and self.max_age_ms is not None:
            raise ServeError("--max-age-ms: one process must follow a robot's clock, not with --workers")
        if self.workers > 1 and self.bundles is not None:
            raise ServeError("--bundles: POST /model would change one process alone: not with --workers")
        if self.max_body < 1 or self.max_connections < 1:
            raise ServeError("--max-body and --max-connections must be at least 1")
        for flag, seconds in (("--read-seconds", self.read_seconds), ("--idle-seconds", self.idle_seconds)):
            if not (math.isfinite(seconds) and seconds > 0.0):
                raise ServeError(f"{flag} must be finite and above 0, got {seconds}")
        if not (math.isfinite(self.drain_seconds) and self.drain_seconds >= 0.0):
            raise ServeError(f"--drain-seconds must be finite and at least 0, got {self.drain_seconds}")
        self.safety()
        self._check_tls()
        self._check_recording()
        if self.bundles is not None and not self.bundles.is_dir():
            raise ServeError(f"--bundles {self.bundles}: no such folder")

    def safety(self) -> Safety:
        """The limits within which it decides, or ServeError for one that is none."""
        flags = (
            ("--deadline-ms", self.deadline_ms),
            ("--max-age-ms", self.max_age_ms),
            ("--hold-after-ms", self.hold_after_ms),
            ("--silent-after-ms", self.silent_after_ms),
        )
        for flag, limit in flags:
            if limit is not None and not (math.isfinite(limit) and limit > 0.0):
                raise ServeError(f"{flag} must be finite and above 0, got {limit}")
        if self.max_in_flight < 1 or self.max_in_flight_all < 1:
            raise ServeError("--max-in-flight and --max-in-flight-all must be at least 1")
        return Safety(
            deadline=None if self.deadline_ms is None else self.deadline_ms / 1e3,
            freshness=Limits(
                max_age=None if self.max_age_ms is None else self.max_age_ms / 1e3,
                hold_after=self.hold_after_ms / 1e3,
                silent_after=self.silent_after_ms / 1e3,
            ),
            max_in_flight=self.max_in_flight,
            max_in_flight_all=self.max_in_flight_all,
        )

    def _check_tls(self) -> None:
        if self.tls_cert is None and self.tls_key is None:
            return
        if self.tls_cert is None or self.tls_key is None:
            raise ServeError("--tls-cert and --tls-key go together")
        for flag, file in (("--tls-cert", self.tls_cert), ("--tls-key", self.tls_key)):
            try:
                file.read_bytes()
            except OSError as error:
                raise ServeError(f"{flag} {file} cannot be read: {error.strerror}") from error
        try:
            # An empty password: OpenSSL would ask the terminal for one.
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(self.tls_cert, self.tls_key, password="")
        except ssl.SSLError as error:
            why = error.reason or "they hold no PEM, or the key has a passphrase"
            files = f"--tls-cert {self.tls_cert} and --tls-key {self.tls_key}"
            raise ServeError(f"{files} are no certificate and its key: {why}") from error

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
        freshness: which robots it knows.
        operation: looked at ten times a second.
        changer: loads the bundle anew on SIGHUP.
        crew: the workers that it is one of.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        lifecycle: Lifecycle,
        drain_seconds: float,
        announcement: str,
        door: Door,
        freshness: Freshness | None = None,
        operation: Operation | None = None,
        changer: Changer | None = None,
        crew: Crew | None = None,
    ) -> None:
        super().__init__(config)
        self._operation = operation
        self._crew = crew
        self._changer = changer
        self._change: asyncio.Task[None] | None = None
        self.server_state = self._door = door
        self._freshness = freshness
        self._lifecycle = lifecycle
        self._drain_seconds = drain_seconds
        self._announcement = announcement
        self._stop_at: float | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts to listen, and says so."""
        if self._crew is not None:
            await self._crew.start()
        await super().startup([])
        # uvicorn would wait a minute for a TLS handshake, in which the door sees no connection yet.
        patience = self._door.patience.read if self.config.ssl else None
        protocol = partial(
            Connection, config=self.config, server_state=self._door, app_state=self.lifespan.state
        )
        self.servers = [
            await asyncio.get_running_loop().create_server(
                protocol,
                sock=listener,
                ssl=self.config.ssl,
                ssl_handshake_timeout=patience,
                backlog=self.config.backlog,
            )
            for listener in sockets or []
        ]
        if self._changer is not None and hasattr(signal, "SIGHUP"):
            asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._on_hangup, self._changer)
        sys.stdout.write(self._announcement + "\n")
        sys.stdout.flush()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """First signal: drain; second: stop at once. Neither is raised again after the shutdown."""
        if self._stop_at is not None:
            self.should_exit = self.force_exit = True
        self._lifecycle.draining = True
        self._stop_at = time.monotonic() + self._drain_seconds

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Closes the door, and then waits for what is in flight."""
        for end in self._lifecycle.at_end:
            end()
        await super().shutdown(sockets)

    async def on_tick(self, counter: int) -> bool:
        """Asked ten times a second whether to stop."""
        self._door.sweep(asyncio.get_running_loop().time())
        if self._freshness is not None:
            self._freshness.sweep(time.perf_counter())
        if self._operation is not None:
            # Not in the signal's handler: it may come in the middle of anything.
            if self._lifecycle.draining:
                self._operation.drain()
            if self._freshness is not None:
                self._operation.unwell(self._freshness.unwell(time.perf_counter()))
            self._operation.tick()
        if self._stop_at is not None and time.monotonic() >= self._stop_at:
            self.should_exit = True
        return await super().on_tick(counter)

    def _on_hangup(self, changer: Changer) -> None:
        async def again() -> None:
            with suppress(ChangeError):  # it was told
                await changer.again()

        self._change = asyncio.get_running_loop().create_task(again())


def listen(host: str, port: int, keys: Keys) -> socket.socket:
    """Opens the listening socket.

    Raises:
        ServeError: if the address cannot be had, or lies beyond loopback and there is no key.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        if not keys.any and not ipaddress.ip_address(address[0]).is_loopback:
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


def read_api_key(path: Path | None, variable: str = KEY_VARIABLE, flag: str = "--api-key-file") -> str | None:
    """A key from a file, else from the environment, else None.

    Args:
        path: the file.
        variable: the environment variable.
        flag: what named the file, for the error.

    Raises:
        ServeError: if the file cannot be read, or the key is empty or not printable ASCII.
    """
    try:
        key = os.environ.get(variable) if path is None else path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServeError(f"{flag} {path}: cannot be read: {error}") from error
    if key is None:
        return None
    if not key or not all("!" <= letter <= "~" for letter in key):
        named = variable if path is None else f"{flag} {path}"
        raise ServeError(f"{named}: the API key must be printable ASCII without spaces, and not empty")
    return key


def read_keys(config: ServeConfig) -> Keys:
    """The keys that a service asks for.

    Raises:
        ServeError: if one cannot be had, or they do not go together.
    """
    try:
        return Keys(
            read=read_api_key(config.read_key_file, READ_KEY_VARIABLE, "--read-key-file"),
            act=read_api_key(config.api_key_file),
            admin=read_api_key(config.admin_key_file, ADMIN_KEY_VARIABLE, "--admin-key-file"),
        )
    except ServeError:
        raise
    except ValueError as error:
        raise ServeError(str(error)) from error


def read_memory_key(path: Path | None) -> bytes | None:
    """The key that seals memories, if a file holds one.

    Raises:
        ServeError: if the file cannot be read, or has too few bytes.
    """
    if path is None:
        return None
    try:
        key = path.read_bytes()
    except OSError as error:
        raise ServeError(f"--memory-key-file {path}: cannot be read: {error.strerror}") from error
    if len(key) < KEY_BYTES:
        raise ServeError(f"--memory-key-file {path} must hold at least {KEY_BYTES} bytes, has {len(key)}")
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


class Place(NamedTuple):
    """A worker's place among the others.

    Attributes:
        crew: the workers that it is one of.
        listener: the socket that all of them accept from.
        memory_key: the key that all of them seal memories with.
    """

    crew: Crew
    listener: socket.socket
    memory_key: bytes


def serve(config: ServeConfig, place: Place | None = None) -> None:
    """Serves until told to stop.

    Args:
        config: the settings.
        place: that of one worker; None: the service is not one of several.

    Raises:
        ServeError: for settings or an address that cannot be had.
        AlarmsError: for settings of alarms that cannot be used.
        BundleError: if the bundle must not be used.
        MonitorError: if it cannot be run with these settings.
        RecordingError: if it cannot be recorded.
    """
    config.check()
    keys = read_keys(config)
    memory_key = place.memory_key if place is not None else read_memory_key(config.memory_key_file)
    rules = read_rules(config.alarms)
    allow_files(config.max_connections)
    if config.workers > 1:
        from server.workers import supervise

        if holds := [name for name, rule in rules.items() if rule.effect == "hold"]:
            raise ServeError(f"--alarms: {holds[0]} would hold one process alone: not with --workers")
        supervise(config, listen(config.host, config.port, keys), memory_key)
        return
    listener = place.listener if place is not None else listen(config.host, config.port, keys)
    with listener:

        def load(bundle: Path) -> Monitor:
            return Monitor.load(bundle, config.gate, config.threshold, config.filter_config(), config.guide)

        monitor = load(config.bundle)
        lifecycle = Lifecycle()
        host, port = listener.getsockname()[:2]
        scheme = "http" if config.tls_cert is None else "https"
        url = f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
        ready = {"event": "listening", "url": url, "host": host, "port": port, "model": monitor.bundle.id}
        gate = {"gate": monitor.gate.name, "threshold": monitor.gate.threshold, "guide": config.guide}
        announcement = json.dumps(ready | gate)
        with Events(config.log) as events, recorder_of(config, monitor) as recorder:
            safety = config.safety()
            if place is not None:
                safety = replace(safety, freshness=replace(safety.freshness, alone=False))
            freshness = Freshness(safety.freshness, monitor.faults.note)
            operation = Operation(monitor, recorder, rules, events)
            changer = Changer(operation, load, config.bundle, config.bundles)
            app = create_app(
                monitor,
                lifecycle,
                keys,
                config.max_body,
                recorder,
                operation=operation,
                changer=changer,
                safety=safety,
                freshness=freshness,
                memory_key=memory_key,
                filter_config=config.filter_config(),
                around=None if place is None else place.crew.around,
            )
            # What is loaded stays: looking through it again and again for garbage would hold up decisions.
            gc.collect()
            gc.freeze()
            crew = None if place is None else place.crew
            server = _server(app, lifecycle, config, announcement, freshness, operation, changer, crew)
            server.run(sockets=[listener])
            operation.stop()


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
    app: Guard,
    lifecycle: Lifecycle,
    config: ServeConfig,
    announcement: str,
    freshness: Freshness,
    operation: Operation,
    changer: Changer,
    crew: Crew | None,
) -> DrainingServer:
    settings = uvicorn.Config(
        app,
        access_log=False,
        log_config=None,  # `Events` tells what it logs
        log_level="error",  # warnings are of what anybody may send, a line each
        lifespan="off",
        ws=StreamConnection,
        ws_max_size=config.max_body,
        ws_ping_interval=None,  # whoever is silent has a deadline
        ws_per_message_deflate=False,  # it would take longer than the decision
        server_header=False,
        http=Connection,
        timeout_keep_alive=math.ceil(config.idle_seconds),
        timeout_graceful_shutdown=_LAST_WORDS,
        ssl_certfile=config.tls_cert,
        ssl_keyfile=config.tls_key,
    )
    patience = Patience(config.read_seconds, config.idle_seconds, config.max_connections)
    door = Door(patience, app.is_robots)
    return DrainingServer(
        settings, lifecycle, config.drain_seconds, announcement, door, freshness, operation, changer, crew
    )


def main() -> None:
    """Entry point of `lagnet-serve`: exit status 0 after an orderly stop, 2 if it could not start."""
    with command("lagnet-serve", ServeError, AlarmsError, BundleError, MonitorError, RecordingError):
        serve(settings(ServeConfig, "lagnet-serve"))


if __name__ == "__main__":
    main()
