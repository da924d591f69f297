"""The recorder's own process, which the service starts: `python -m recorder.process`.

It reads from its standard input what the service hands on, writes the files, and tells on its standard output
how it stands. That it is another process keeps the work off the service's interpreter, and lets the files be
ended in order when the service is killed.

The frames are: the settings; then lists of exchanges, of causes for a file of an incident, as texts, and of
what decides from then on, as objects, an empty one again and again; None before an orderly end.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from recorder.channels import Scribe
from recorder.exchange import Exchange
from recorder.frames import frames
from recorder.incidents import Incidents
from recorder.tape import Folder, Recording

_NICENESS = 10
"""By how much the service comes first where there are too few processors."""
_TELL_SECONDS = 0.2
_KILLED = "the service ended without a word"


class Process:
    """Takes what the service hands on.

    Args:
        settings: as `recorder.recorder.Settings` tells them, with `about`.

    Raises:
        OSError: if a folder cannot be made.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        about = settings["about"]
        self._scribe = Scribe(about["layout"])
        self._recording: Recording | None = None
        self._incidents: Incidents | None = None
        self._stopped: dict[str, str] = {}
        if settings["record"] is not None:
            folder = Folder(Path(settings["record"]), "recording", settings["record_bytes"])
            self._recording = Recording(folder, about, settings["file_bytes"])
        if settings["incidents"] is not None:
            most = settings["incidents_bytes"]
            folder = Folder(Path(settings["incidents"]), "incident", most)
            self._incidents = Incidents(folder, about, self._scribe, most // 4)

    def take(self, batch: list[Any]) -> None:
        """Takes what the service hands on."""
        for item in batch:
            if isinstance(item, str):
                self._incident(item, time.time_ns())
            elif isinstance(item, dict):
                self._change(item)
            else:
                self._exchange(Exchange(*item))
        if self._recording is not None:
            self._trying("recording", self._recording.flush_if_due)
        if self._incidents is not None:
            self._trying("incidents", self._incidents.flush_if_due)

    def status(self) -> dict[str, Any]:
        """How it stands."""
        told: dict[str, Any] = {"stopped": self._stopped}
        if self._recording is not None:
            told["recorded"] = self._recording.count
        if self._incidents is not None:
            told |= {"incidents": self._incidents.count, "last_incident": self._incidents.last}
        return told

    def close(self, in_order: bool) -> None:
        """Ends the files.

        Args:
            in_order: whether the service said that it ends.
        """
        if not in_order:
            self._incident(_KILLED, time.time_ns())
        if self._recording is not None:
            self._trying("recording", self._recording.close)
        if self._incidents is not None:
            self._trying("incidents", self._incidents.close)

    def _exchange(self, exchange: Exchange) -> None:
        entries, incident = self._scribe.entries(exchange)
        if self._recording is not None:
            recording = self._recording
            self._trying("recording", lambda: recording.add(exchange, entries))
        if self._incidents is not None:
            incidents = self._incidents
            self._trying("incidents", lambda: incidents.add(exchange, entries))
        if incident is not None:
            self._incident(incident, exchange.received)

    def _change(self, about: dict[str, Any]) -> None:
        """Another one decides: no file holds the decisions of both."""
        if self._recording is not None:
            recording = self._recording
            self._trying("recording", lambda: recording.change(about))
        if self._incidents is not None:
            incidents = self._incidents
            self._trying("incidents", lambda: incidents.change(about, time.time_ns()))

    def _incident(self, why: str, at: int) -> None:
        if self._incidents is not None:
            incidents = self._incidents
            self._trying("incidents", lambda: incidents.happened(why, at))

    def _trying(self, what: str, write: Callable[[], None]) -> None:
        """Does what may fail; what failed once stops for good, and the other goes on."""
        if what in self._stopped:
            return
        try:
            write()
        except OSError as error:
            self._stopped[what] = error.strerror or type(error).__name__


def main() -> None:
    """Records until its input ends."""
    # Whatever ends the service, it is the end of its input that ends this.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    sent = frames(sys.stdin.buffer)
    try:
        process = Process(next(sent))
    except OSError as error:
        _tell({"failed": f"{error.filename}: {error.strerror}"})
        return
    _tell(process.status())
    told, at, in_order = process.status(), time.monotonic(), False
    for batch in sent:
        in_order = batch is None
        if batch is None:
            break
        process.take(batch)
        if time.monotonic() - at >= _TELL_SECONDS and (status := process.status()) != told:
            _tell(status)
            told, at = json.loads(json.dumps(status)), time.monotonic()
    process.close(in_order)
    _tell(process.status())


def _tell(status: dict[str, Any]) -> None:
    try:
        sys.stdout.write(json.dumps(status) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:  # the service is gone; its last words are still to be written
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123


if __name__ == "__main__":
    main()
