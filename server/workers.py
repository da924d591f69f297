"""Several processes behind one address: starts them, starts again what dies, and ends them in order.

All of them accept from one listening socket, which they inherit. A connection that nobody has accepted yet
outlives a worker that is killed; with a socket each (SO_REUSEPORT) it would be lost with it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import signal
import socket
import sys
import tempfile
from asyncio.subprocess import PIPE, Process
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from server.crew import Roster, ask
from server.events import Events
from server.keeper import KEY_BYTES
from server.serve import ServeConfig
from server.worker import ORDER, ROSTER, Order

_SOON = 10.0
"""Where a worker ends within this time [s], it is not started again at once."""
_MOST_SILENT = 5
"""A worker that was asked so many times in a row and did not answer is killed."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 30.0
_FAILED = 2

_LOG = logging.getLogger("lagnet.workers")


def supervise(config: ServeConfig, listener: socket.socket, memory_key: bytes | None) -> None:
    """Serves with several workers until told to stop.

    Args:
        config: the settings; they have been checked.
        listener: what all of them accept from.
        memory_key: what they seal memories with; None: one made at random.

    Raises:
        SystemExit: if one of them cannot start; it has said why.
    """
    key = memory_key or secrets.token_bytes(KEY_BYTES)
    with Events(config.log), tempfile.TemporaryDirectory(prefix="lagnet-") as folder:
        asyncio.run(Supervisor(config, listener, Path(folder), key).run())


def part(config: ServeConfig, number: int) -> ServeConfig:
    """One worker's part of the settings: recordings go to a folder of its own, and share the room.

    Args:
        config: the service's settings.
        number: the worker's, from 1.
    """
    name, workers = f"worker-{number}", config.workers
    return replace(
        config,
        workers=1,
        record=None if config.record is None else config.record / name,
        record_mb=config.record_mb / workers,
        incidents=None if config.incidents is None else config.incidents / name,
        incidents_mb=config.incidents_mb / workers,
    )


class Supervisor:
    """Starts the workers of a service and watches over them.

    Args:
        config: the settings; they have been checked.
        listener: what the workers accept from; it is closed here when they are to stop.
        folder: where they talk to each other; nobody else may read it.
        key: what they seal memories with.
    """

    def __init__(self, config: ServeConfig, listener: socket.socket, folder: Path, key: bytes) -> None:
        numbers = range(1, config.workers + 1)
        places = [folder / f"{number}.sock" for number in numbers]
        self._orders = {n: Order(part(config, n), n, listener.fileno(), places, key.hex()) for n in numbers}
        self._listener = listener
        self._roster = Roster(config.workers)
        self._running: dict[int, Process] = {}
        self._stop, self._anew = asyncio.Event(), asyncio.Event()
        self._starting = asyncio.Lock()

    async def run(self) -> None:
        """Serves until told to stop.

        Raises:
            SystemExit: if a worker cannot start.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._end)
        loop.add_signal_handler(signal.SIGHUP, self._anew.set)
        renewal = asyncio.create_task(self._renew())
        try:
            # Settings that cannot be served are told by the first alone, and it compiles for the others.
            first, *others = self._orders
            if said := await self._start(first):
                await asyncio.gather(*map(self._start, others))
            if len(self._roster.ready) < len(self._orders):
                raise SystemExit(0 if self._stop.is_set() else _FAILED)
            sys.stdout.write(json.dumps(json.loads(said) | {"workers": len(self._orders)}) + "\n")
            sys.stdout.flush()
            await asyncio.gather(*map(self._keep, self._orders))
        finally:
            renewal.cancel()
            if not self._stop.is_set():
                self._end()
            await asyncio.gather(*(process.wait() for process in self._running.values()))

    async def _start(self, number: int) -> bytes:
        """Starts a worker in the place of one that ended; what it says when it listens, or nothing."""
        self._running[number] = process = await self._spawn(number)
        if said := await _announcement(process):
            self._roster.ready = sorted({*self._roster.ready, number})
            self._tell()
        return said

    async def _spawn(self, number: int) -> Process:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "server.worker"),
            stdin=PIPE,
            stdout=PIPE,
            pass_fds=[self._listener.fileno()],
            process_group=0,  # Ctrl-C in the terminal reaches the supervisor alone
        )
        assert process.stdin is not None
        process.stdin.write(ORDER.dump_json(self._orders[number]) + b"\n")
        if self._stop.is_set():  # meanwhile
            _send(process, signal.SIGTERM)
        return process

    async def _keep(self, number: int) -> None:
        """Watches over a worker that listens, and starts it again when it ends."""
        loop = asyncio.get_running_loop()
        pause = 0.0
        while True:
            since, process = loop.time(), self._running[number]
            watch = asyncio.create_task(self._watch(number, process))
            status = await process.wait()
            watch.cancel()
            if self._stop.is_set():
                return
            if self._running[number] is not process:
                continue  # another took its place
            roster = self._roster
            roster.ready = [other for other in roster.ready if other != number]
            roster.restarts += 1
            roster.last = f"worker {number} {_how(status)}"
            _LOG.warning("%s and is started again", roster.last)
            self._tell()
            soon = loop.time() - since < _SOON
            pause = min(max(2.0 * pause, _FIRST_PAUSE), _LONGEST_PAUSE) if soon else 0.0
            with suppress(TimeoutError):
                await asyncio.wait_for(self._stop.wait(), pause)
                return
            async with self._starting:
                if self._running[number] is process:
                    await self._start(number)

    async def _watch(self, number: int, process: Process) -> None:
        """Kills a worker that hangs."""
        place, silent = self._orders[number].places[number - 1], 0
        while silent < _MOST_SILENT:
            await asyncio.sleep(1.0)
            silent = silent + 1 if await ask(place, "/healthz") is None else 0
        if not self._stop.is_set() and self._running[number] is process:
            _LOG.error("worker %d does not answer and is killed", number)
            _send(process, signal.SIGKILL)

    async def _renew(self) -> None:
        """On SIGHUP puts a new process in the place of each worker, which drains once the new one listens.

        The first that cannot start ends it: the bundle may be no good, and the old workers serve on.
        """
        while True:
            await self._anew.wait()
            self._anew.clear()
            for number in self._orders:
                async with self._starting:
                    process = await self._spawn(number)
                    if not await _announcement(process):
                        _LOG.error("worker %d could not be started anew: those that run stay", number)
                        break
                    old, self._running[number] = self._running[number], process
                _send(old, signal.SIGTERM)
                self._roster.ready = sorted({*self._roster.ready, number})
                self._tell()
                _LOG.warning("worker %d was started anew", number)

    def _tell(self) -> None:
        """Tells every worker where the others stand."""
        line = ROSTER.dump_json(self._roster) + b"\n"
        for process in self._running.values():
            if process.stdin is not None and process.returncode is None:
                process.stdin.write(line)

    def _end(self) -> None:
        """The first time the workers drain, the second time they stop at once."""
        self._stop.set()
        # Held open here, it would take connections that nobody answers.
        self._listener.close()
        for process in self._running.values():
            _send(process, signal.SIGTERM)


async def _announcement(process: Process) -> bytes:
    """What a worker says when it listens; nothing if it ended before."""
    assert process.stdout is not None
    return await process.stdout.readline()


def _send(process: Process, number: signal.Signals) -> None:
    """Sends a signal. asyncio's own way might reap the process before asyncio learns how it ended."""
    if process.returncode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, number)


def _how(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"was killed by signal {-status}"
