"""The service's side of the recorder: hands every exchange on to the recorder's process, and never waits."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from threading import Event, Thread
from types import TracebackType
from typing import IO, Any, Self, cast

from recorder.backlog import Backlog
from recorder.errors import RecordingError
from recorder.frames import frame

HAND_ON_SECONDS = 0.05
"""How often what has been recorded is handed on [s]."""
MOST_WAITING = 64 << 20
"""Bytes that may wait to be handed on; what comes on top is dropped, and counted."""
_START_SECONDS = 30.0
_END_SECONDS = 5.0
_QUIET_SECONDS = 60.0
_PIPE = 1 << 20

_LOG = logging.getLogger("lagnet.recorder")


@dataclass(frozen=True)
class Settings:
    """What is recorded where.

    Attributes:
        record: folder for everything, or None.
        record_bytes: size of all its recordings; the oldest go.
        file_bytes: size of one.
        incidents: folder for incidents, or None.
        incidents_bytes: size of all its files of incidents; the oldest go.
    """

    record: str | None
    record_bytes: int
    file_bytes: int
    incidents: str | None
    incidents_bytes: int


class Recorder:
    """Records what a service is asked and answers.

    Args:
        settings: what and where.
        model: what decides, as `GET /model` tells it.
        filter_config: the filter's settings, as plain JSON.

    Attributes:
        dropped: how many exchanges were not recorded because too many were waiting.

    Raises:
        RecordingError: if it cannot start.
    """

    def __init__(
        self, settings: Settings, model: Mapping[str, Any], filter_config: Mapping[str, Any]
    ) -> None:
        self.dropped = 0
        self._stopped: dict[str, str] = {}
        self._status: dict[str, Any] = {}
        self._backlog = Backlog(MOST_WAITING)
        self._number = 0
        self._gone = False
        self._closing, self._ready = Event(), Event()
        self._failed: str | None = None
        self._filter_config = filter_config
        # What it says besides goes where the service's own complaints go.
        command = [sys.executable, "-m", "recorder.process"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._pipe = cast(IO[bytes], self._process.stdin)
        self._words = cast(IO[bytes], self._process.stdout)
        _widen(self._pipe)
        self._listener = Thread(target=self._listen, name="recorder listens", daemon=True)
        self._listener.start()
        self._send(frame(asdict(settings) | {"about": self._about(model)}))
        if not self._ready.wait(_START_SECONDS) or self._failed is not None or self._gone:
            self._process.kill()
            self._process.wait()
            raise RecordingError(self._failed or "the recorder's process did not start")
        self._sender = Thread(target=self._hand_on, name="recorder sends", daemon=True)
        self._sender.start()

    @property
    def alarm(self) -> str | None:
        """What is no longer recorded, and why; None while all is well."""
        return "; ".join(f"{what} stopped: {why}" for what, why in sorted(self._stopped.items())) or None

    def status(self) -> dict[str, Any]:
        """How it stands, as plain JSON: alarm, dropped, waiting, recorded, incidents, last_incident."""
        told = {name: value for name, value in self._status.items() if name != "stopped"}
        return {"alarm": self.alarm, "dropped": self.dropped, "waiting": self._backlog.size} | told

    def record(
        self, received: int, client: tuple[str, int] | None, status: int, request: bytes, reply: bytes
    ) -> None:
        """Records a request and its reply; to be called from one thread alone.

        Args:
            received: when the request had come [ns since 1970].
            client: address and port of who asked.
            status: the reply's.
            request: its body.
            reply: its body.
        """
        if self._gone:
            return
        self._number += 1
        exchange = self._number, received, time.time_ns(), client, status, request, reply
        if not self._backlog.put([exchange]):
            self.dropped += 1

    def incident(self, why: str) -> None:
        """Has the last half minute written; for alarms, from any thread.

        Args:
            why: what has happened.
        """
        self._put(why)

    def change(self, model: Mapping[str, Any]) -> None:
        """Another one decides from now on: what follows has files of its own; from the thread of `record`.

        Args:
            model: what decides, as `GET /model` tells it; with the same observation layout and filter.
        """
        self._put(self._about(model))

    def close(self) -> None:
        """Ends the recording: what was recorded up to now is written."""
        self._closing.set()
        self._sender.join(_END_SECONDS)
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join(_END_SECONDS)
        self._words.close()

    def __enter__(self) -> Self:
        """The recorder."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the recording."""
        self.close()

    def _put(self, value: str | dict[str, Any]) -> None:
        """Has something wait that is seldom and small: it is never dropped."""
        if not self._gone:
            self._backlog.put([value], always=True)

    def _hand_on(self) -> None:
        """Sends what has been recorded, again and again, and at the end that it is the end."""
        logged, quiet = 0, 0.0
        while not self._gone:
            last = self._closing.wait(HAND_ON_SECONDS)
            while not self._gone and self._backlog.hand_on(self._send):
                if self.dropped > logged and time.monotonic() >= quiet:
                    logged, quiet = self.dropped, time.monotonic() + _QUIET_SECONDS
                    _LOG.warning("%d decisions were not recorded so far: too many at once", logged)
            # The other side has no clock of its own.
            self._send(frame([]))
            if last:
                self._send(frame(None))
                break
        self._backlog.clear()
        with suppress(OSError):
            self._pipe.close()

    def _about(self, model: Mapping[str, Any]) -> dict[str, Any]:
        """What is written into each file of what decided."""
        release = version("lagnet")
        text = {"version": release, "model": json.dumps(model), "filter": json.dumps(self._filter_config)}
        return {"version": release, "text": text, "layout": list(model["observation_layout"])}

    def _send(self, frames: bytes | memoryview) -> None:
        try:
            self._pipe.write(frames)
            self._pipe.flush()
        except OSError:
            self._gone = True

    def _listen(self) -> None:
        """Hears how the other process stands, until it ends."""
        for line in self._words:
            told = json.loads(line)
            self._failed = told.pop("failed", None)
            for what, why in told.get("stopped", {}).items():
                self._stop(what, why)
            self._status = told
            self._ready.set()
        self._gone = True
        if not self._closing.is_set() and self._failed is None:
            self._stop("recorder", "its process ended")
        self._ready.set()

    def _stop(self, what: str, why: str) -> None:
        if what not in self._stopped:
            self._stopped = self._stopped | {what: why}
            _LOG.error("%s stopped: %s; the service goes on", what, why)


def _widen(pipe: IO[bytes]) -> None:
    """Lets a pipe hold more, where that can be set: what it holds outlives a service that is killed."""
    if sys.platform == "linux":
        import fcntl

        with suppress(OSError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE)
