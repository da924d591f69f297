"""A service started for a while: as a process of its own, stopped whatever happens."""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from evaluation.errors import ServiceError
from monitor import GateName
from server.serve import ADMIN_KEY_VARIABLE, KEY_VARIABLE, READ_KEY_VARIABLE

_START_SECONDS = 180.0
_STOP_SECONDS = 10.0
_KEYS = (READ_KEY_VARIABLE, KEY_VARIABLE, ADMIN_KEY_VARIABLE)
# Looked up here: between fork and exec nothing may wait for a lock that another thread held.
_PRCTL = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Service:
    """A running service; as a context manager it is stopped at the end, also on an error or Ctrl-C.

    On Linux it also ends with the thread that started it, however that ends.

    Attributes:
        process: its process.
        url: where it listens.
        errors: the file that holds what it writes to its standard error.
    """

    process: subprocess.Popen[str]
    url: str
    errors: IO[str]

    def complaints(self) -> str:
        """What it has written to its standard error so far."""
        self.errors.seek(0)
        return self.errors.read()

    @staticmethod
    def start(bundle: Path, gate: GateName, threshold: float | None = None, *flags: str) -> Service:
        """Starts `lagnet-serve` on a free port of the loopback.

        Args:
            bundle: the bundle's folder.
            gate: when the filter is active.
            threshold: the gate's; None: the bundle's.
            flags: further words of the command.

        Raises:
            ServiceError: if it ends or does not listen within three minutes (a first start compiles).
        """
        command = [sys.executable, "-m", "server.serve", str(bundle), "--port", "0", "--gate", gate, *flags]
        if threshold is not None:
            command += ["--threshold", str(threshold)]
        return Service.run(command)

    @staticmethod
    def run(command: Sequence[str]) -> Service:
        """Runs a command that prints one line of JSON with its "url" once it listens.

        Raises:
            ServiceError: if it ends or does not listen within three minutes (a first start compiles).
        """
        # It is ours alone and asks for no key, unless the command names one.
        environment = {name: value for name, value in os.environ.items() if name not in _KEYS}
        # A session of its own: Ctrl-C in the terminal reaches us alone, and we stop the service in order.
        # A file, not a pipe: nobody reads it while the service runs, and a full pipe would block it.
        errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  (it lives as long as the service)
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            preexec_fn=end_with_parent,  # noqa: PLW1509  (it takes no lock)
            env=environment | {"OMP_NUM_THREADS": "1"},
        )
        try:
            return Service(process, _read_url(process, errors), errors)
        except BaseException:
            _stop(process)
            raise

    def stop(self) -> int:
        """Stops it in order, or by force if that takes too long; returns its exit status."""
        return _stop(self.process)

    def __enter__(self) -> Self:
        """The running service."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops it."""
        self.stop()


def end_with_parent() -> None:
    """Run in a new process on Linux: SIGTERM comes when its parent is gone, by kill -9 for example."""
    if _PRCTL is not None:
        _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _read_url(process: subprocess.Popen[str], errors: IO[str]) -> str:
    if process.stdout is None:
        raise ServiceError("the service has no output")
    ready, _, _ = select.select([process.stdout], [], [], _START_SECONDS)
    line = process.stdout.readline() if ready else ""
    if not line:
        _stop(process)
        errors.seek(0)
        raise ServiceError(
            f"the service did not start: {errors.read().strip() or 'it did not listen in time'}"
        )
    return str(json.loads(line)["url"])


def _stop(process: subprocess.Popen[str]) -> int:
    process.terminate()
    try:
        process.wait(_STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
    return process.wait()
