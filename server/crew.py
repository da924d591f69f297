"""One worker among several: what each process alone knows is asked of all, and told as one answer."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.keys import ACT, BATCH, HEALTH

ANY_WORKER = frozenset({("POST", ACT), ("POST", BATCH), ("GET", "/model"), ("GET", "/openapi.json")})
"""What any worker answers alike: the memory travels with the robot, and all run the same bundle."""
METRICS = "/metrics"
ALL_WORKERS = HEALTH | {METRICS, "/alarms", "/robots"}
"""What is read of all workers."""
_ANY_REPLICA = ANY_WORKER | {("GET", path) for path in HEALTH}
HTTP_OK = 200
_ANSWER_SECONDS = 0.5
"""How long a worker may take to tell the others what it knows [s]."""
_SAMPLE = re.compile(r"^([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})?( .*)$")
"""A line of Prometheus' text format: name, labels, the rest."""


@dataclass
class Roster:
    """What the supervisor tells its workers.

    Attributes:
        workers: how many there should be.
        ready: the numbers of those that listen.
        restarts: how often one was started again.
        last: the last end of one that was not asked for, in words.
    """

    workers: int = 1
    ready: list[int] = field(default_factory=list)
    restarts: int = 0
    last: str | None = None


class Told(NamedTuple):
    """A worker's answer to the others."""

    status: int
    body: bytes
    kind: bytes = b"application/json"
    """Its content type."""


class Crew:
    """The workers of one service, as one of them sees the others.

    Requests that hang on what one process alone knows are answered for all of them, or refused: what only one
    of them heard would be lost with it, or be wrong.

    Args:
        number: this worker's, from 1.
        places: the sockets at which the workers talk to each other, in order.

    Attributes:
        roster: what the supervisor told last.
    """

    def __init__(self, number: int, places: Sequence[Path]) -> None:
        self.roster = Roster(len(places))
        self._number = number
        self._places = places
        self._app: ASGIApp | None = None
        self._server: asyncio.Server | None = None

    def around(self, app: ASGIApp) -> ASGIApp:
        """The app of the whole service.

        Args:
            app: this worker's own.
        """
        self._app = app
        return self

    async def start(self) -> None:
        """Begins to tell the others, when they ask."""
        place = self._places[self._number - 1]
        place.unlink(missing_ok=True)
        self._server = await asyncio.start_unix_server(self._tell, place)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one connection."""
        assert self._app is not None
        path = scope["path"]
        if scope["type"] != "http" or (scope["method"], path) in ANY_WORKER:  # a stream, or one of these
            await self._app(scope, receive, send)
        elif scope["method"] == "GET" and path in ALL_WORKERS:
            await _answer(send, await self.all(path))
        else:
            await _answer(send, _refusal(scope, "one of the workers alone: not with --workers"))

    async def all(self, path: str) -> Told:
        """What all workers answer to a GET, as one answer; the worst of their statuses is its."""
        numbers = range(1, len(self._places) + 1)
        answers = await asyncio.gather(
            *(
                self._own(path) if number == self._number else ask(self._places[number - 1], path)
                for number in numbers
            )
        )
        told = {number: answer for number, answer in zip(numbers, answers, strict=True) if answer is not None}
        worst = max(told.values(), key=lambda answer: answer.status)
        if path != METRICS:
            return Told(worst.status, json.dumps(self._summed(told, worst)).encode())
        if worst.status != HTTP_OK:
            return worst
        texts = {number: answer.body.decode() for number, answer in told.items()}
        return Told(HTTP_OK, (labelled(texts) + self._metrics()).encode(), worst.kind)

    def _summed(self, told: Mapping[int, Told], worst: Told) -> dict[str, Any]:
        answers = [(number, json.loads(answer.body)) for number, answer in told.items()]
        each = [
            {"worker": number} | (said if isinstance(said, dict) else {"list": said})
            for number, said in answers
        ]
        said = json.loads(worst.body)
        about = {"status": said["status"]} if isinstance(said, dict) and "status" in said else {}
        return about | asdict(self.roster) | {"each": each}

    def _metrics(self) -> str:
        roster = self.roster
        return "".join(
            f"# HELP {name} {about}.\n# TYPE {name} {kind}\n{name} {number}\n"
            for name, kind, about, number in (
                ("lagnet_workers", "gauge", "Workers that there should be", roster.workers),
                ("lagnet_workers_ready", "gauge", "Workers that listen", len(roster.ready)),
                ("lagnet_worker_restarts_total", "counter", "Workers started again", roster.restarts),
            )
        )

    async def _tell(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers another worker."""
        with suppress(OSError):
            path = (await reader.readline()).decode().strip()
            if path in ALL_WORKERS:
                status, body, kind = await self._own(path)
                writer.write(b"%d %b\n%b" % (status, kind, body))
        writer.close()

    async def _own(self, path: str) -> Told:
        """What this worker answers to a GET."""
        assert self._app is not None
        status, kind, parts = 500, b"", []

        async def receive() -> Message:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Message) -> None:
            nonlocal status, kind
            if message["type"] == "http.response.start":
                status, kind = message["status"], dict(message["headers"]).get(b"content-type", b"")
            else:
                parts.append(message.get("body", b""))

        scope = {
            **{"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "scheme": "http"},
            **{"method": "GET", "path": path, "raw_path": path.encode(), "root_path": ""},
            **{"query_string": b"", "headers": [], "client": None, "server": None},
        }
        await self._app(scope, receive, send)
        return Told(status, b"".join(parts), kind)


async def ask(place: Path, path: str) -> Told | None:
    """What a worker answers to a GET; None if it does not.

    Args:
        place: its socket.
        path: one of `ALL_WORKERS`.
    """
    with suppress(OSError, ValueError, TimeoutError):
        async with asyncio.timeout(_ANSWER_SECONDS):
            reader, writer = await asyncio.open_unix_connection(place)
            try:
                writer.write(path.encode() + b"\n")
                head, _, body = (await reader.read()).partition(b"\n")
            finally:
                writer.close()
            status, kind = head.split(b" ", 1)
            return Told(int(status), body, kind)
    return None


def labelled(texts: Mapping[int, str]) -> str:
    """The metrics of several workers in one text, each sample with the label `worker`.

    Args:
        texts: number of the worker → its metrics in Prometheus' text format.
    """
    heads: dict[str, list[str]] = {}
    samples: dict[str, list[str]] = {}
    for number, text in texts.items():
        family = ""
        for line in text.split("\n"):  # a label may hold what else ends a line
            if line.startswith("#"):
                words = line.split(" ", 3)
                if len(words) > 2 and words[2] != family:
                    family = words[2]
                known = heads.setdefault(family, [])
                if line not in known:
                    known.append(line)
            elif found := _SAMPLE.match(line):
                name, labels, rest = found.groups()
                more = f",{labels}" if labels else ""
                samples.setdefault(family, []).append(f'{name}{{worker="{number}"{more}}}{rest}')
    # All samples of a family stand together.
    lines = [line for family in heads for line in (*heads[family], *samples.get(family, []))]
    return "\n".join(lines) + "\n"


class Alike:
    """One of several replicas that know nothing of each other: answers what any of them answers alike.

    Args:
        app: the replica's own app.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one connection."""
        if scope["type"] == "http" and (scope["method"], scope["path"]) not in _ANY_REPLICA:
            await _answer(send, _refusal(scope, "one of the replicas alone"))
        else:  # a stream, or one of these
            await self._app(scope, receive, send)


def _refusal(scope: Scope, whom: str) -> Told:
    message = f"{scope['method']} {scope['path']} would reach {whom}"
    detail = [{"loc": ["path"], "msg": message, "type": "refused"}]
    return Told(501, json.dumps({"detail": detail}).encode())


async def _answer(send: Send, told: Told) -> None:
    headers = [(b"content-type", told.kind), (b"content-length", b"%d" % len(told.body))]
    await send({"type": "http.response.start", "status": told.status, "headers": headers})
    await send({"type": "http.response.body", "body": told.body})
