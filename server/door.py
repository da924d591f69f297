"""Who may stay connected: whoever is silent, slow, or does not read goes, and never at a robot's cost.

uvicorn counts every open socket against one limit and waits for a request's bytes for as long as they take:
a few hundred connections that say nothing would shut out every robot. Here each connection has a deadline for
what it owes, and where there are too many, the one that was heard of longest ago makes room.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast
from weakref import ref

import httptools
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle
from uvicorn.server import ServerState

from server.guard import AT_ONCE, FULL

MAX_HEAD = 65536
"""Most bytes that may come before a request's head is whole; a robot's has 200."""

MAX_AHEAD = 32
"""Most requests that a connection may send ahead of its answers; a robot sends none."""

_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
_HEAD_TOO_LARGE = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
)


@dataclass(frozen=True)
class Patience:
    """How long and how many are waited for.

    Attributes:
        read: how long a new connection may take to its first byte, a request from its first byte to its last,
            and a reply to be taken [s].
        idle: how long a connection may be silent between two requests [s].
        robots: most connections of robots; as many again may have asked for no decision yet.
    """

    read: float = 5.0
    idle: float = 75.0
    robots: int = 512


class Door(ServerState):
    """The open connections of one service.

    A connection is a newcomer until it brings a robot's whole request; from then on it is a robot's.
    Newcomers only ever displace newcomers.

    Args:
        patience: the limits.
        is_robots: whether a request, by its ASGI scope, is one that only a robot makes.
    """

    def __init__(self, patience: Patience, is_robots: Callable[[Mapping[str, Any]], bool]) -> None:
        super().__init__()
        self.patience = patience
        self._is_robots = is_robots
        # Both in order: whoever came, or was answered, longest ago is first.
        self._newcomers: dict[Bounded, None] = {}
        self._robots: dict[Bounded, None] = {}

    def enter(self, connection: Bounded) -> None:
        """Lets a new connection in; the oldest newcomer makes room."""
        _make_room(self._newcomers, self.patience.robots)
        self._newcomers[connection] = None

    def heard(self, connection: Bounded, scope: Mapping[str, Any]) -> None:
        """A whole request has come."""
        robot = connection in self._robots
        self.leave(connection)
        if robot or self._is_robots(scope):
            _make_room(self._robots, self.patience.robots)
            self._robots[connection] = None
        else:
            self._newcomers[connection] = None

    def full(self, connection: Bounded) -> bool:
        """Whether there is no room for one more robot: all of them await their answers."""
        return (
            len(self._robots) >= self.patience.robots
            and connection not in self._robots
            and _longest_idle(self._robots) is None
        )

    def leave(self, connection: Bounded) -> None:
        """A connection is closed."""
        self._newcomers.pop(connection, None)
        self._robots.pop(connection, None)

    def sweep(self, now: float) -> None:
        """Closes the connections whose deadline has passed.

        Args:
            now: on the event loop's clock [s].
        """
        for connection in cast(set[Bounded], self.connections).copy():
            if connection.deadline < now:
                connection.turn_away()


class Bounded(asyncio.Protocol):
    """A connection with a deadline for what the other side owes; stands before a protocol of uvicorn.

    Attributes:
        deadline: when it is closed, on the event loop's clock [s].
    """

    deadline = math.inf
    loop: asyncio.AbstractEventLoop
    _reading = False
    """Whether a request or a frame has begun and not all of it has come."""
    _clogged = False
    """Whether the other side does not take what it is sent."""

    def __init__(self, config: Config, server_state: ServerState, app_state: dict[str, Any]) -> None:
        super().__init__(config, server_state, app_state)  # type: ignore[call-arg]  # uvicorn's, not object's
        self._door = cast(Door, server_state)

    @property
    def awaits_answer(self) -> bool:
        """Whether it is not the other side's turn to speak."""
        raise NotImplementedError

    def turn_away(self) -> None:
        """Closes it."""
        raise NotImplementedError

    def connection_made(self, transport: Any) -> None:
        """It begins."""
        super().connection_made(transport)
        self._allow(self._door.patience.read)
        self._door.enter(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """It is closed, by whichever side."""
        self._door.leave(self)
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """The other side does not take what it is sent."""
        self._allow(self._door.patience.read)
        self._clogged = True
        super().pause_writing()

    def resume_writing(self) -> None:
        """It does again."""
        self._clogged = False
        super().resume_writing()
        if self.awaits_answer:
            self._allow(math.inf)
        else:
            self._allow(self._door.patience.read if self._reading else self._door.patience.idle)

    def _allow(self, seconds: float) -> None:
        """Sets the deadline, unless it is one for taking what was sent."""
        if not self._clogged:
            self.deadline = self.loop.time() + seconds


class Connection(Bounded, HttpToolsProtocol):
    """uvicorn's connection, with a deadline."""

    _head = 0
    """How many bytes of its head have come; -1 once the head is whole."""

    @property
    def awaits_answer(self) -> bool:
        """Whether a whole request has come and is not answered yet."""
        cycle = self.cycle
        return cycle is not None and not cycle.more_body and not cycle.response_complete

    def data_received(self, data: bytes) -> None:
        """Some bytes have come."""
        super().data_received(data)
        if self._reading and self._head >= 0:
            self._head += len(data)
            if self._head > MAX_HEAD and not self.transport.is_closing():
                self.transport.write(_HEAD_TOO_LARGE)
                self.transport.close()

    def on_message_begin(self) -> None:
        """The first byte of a request."""
        self._reading, self._head = True, 0
        self._allow(self._door.patience.read)
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """The request's head has come whole."""
        self._head = -1
        if len(self.pipeline) >= MAX_AHEAD:
            # uvicorn would keep them all, however many come.
            raise httptools.HttpParserError("too many requests ahead of their answers")
        super().on_headers_complete()
        if self.cycle is None or self.cycle.scope is not self.scope:
            return  # it becomes a stream
        # The scope is the cycle's own: one that held it would be garbage that only the collector finds.
        extensions: dict[str, Any] = {AT_ONCE: partial(self._at_once, ref(self.cycle))}
        self.scope["extensions"] = extensions | {FULL: self._door.full(self)}

    def handle_websocket_upgrade(self) -> None:
        """It goes on as a stream."""
        self._door.leave(self)
        super().handle_websocket_upgrade()

    def on_message_complete(self) -> None:
        """The request has come whole: from here on it is we who are slow."""
        if self.parser.should_upgrade() and self._should_upgrade():
            return
        self._reading = False
        self._allow(math.inf)
        self._door.heard(self, self.scope)
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """The answer is on its way."""
        # A request may be answered before all of it has come, and the next one may have begun.
        if not self._reading:
            self._allow(self._door.patience.idle)
        super().on_response_complete()

    def turn_away(self) -> None:
        """Closes the connection, with a word to whoever is in the middle of a request."""
        if self.transport.is_closing() or self.transport.get_write_buffer_size():
            # What is unsent would keep it open for as long as the other side does not take it.
            self.transport.abort()
            return
        if self._reading and self._has_its_say():
            self.transport.write(_TOO_SLOW)
        self.transport.close()

    def _at_once(self, asked: ref[RequestResponseCycle], status: int, content: bytes) -> bool:
        """Answers a request with JSON in one packet; uvicorn would send head and body apart."""
        cycle = asked()
        if cycle is None or cycle.disconnected or self.flow.write_paused:
            return False
        head = [STATUS_LINE[status], *(b"%b: %b\r\n" % header for header in cycle.default_headers)]
        if not cycle.keep_alive:
            head.append(b"connection: close\r\n")
        head.append(b"content-type: application/json\r\ncontent-length: %d\r\n\r\n" % len(content))
        cycle.response_started = cycle.response_complete = True
        self.transport.write(b"".join([*head, content]))
        cycle.message_event.set()
        if not cycle.keep_alive:
            self.transport.close()
        cycle.on_response()
        return True

    def _has_its_say(self) -> bool:
        """Whether the next word to the other side is the answer to the request that is being read."""
        if self.cycle is None or self._head >= 0:
            return self.cycle is None or self.cycle.response_complete
        return not self.cycle.response_started and not self.pipeline


def _longest_idle(connections: dict[Bounded, None]) -> Bounded | None:
    return next((connection for connection in connections if not connection.awaits_answer), None)


def _make_room(connections: dict[Bounded, None], most: int) -> None:
    """Makes room for one more, if one of them can go."""
    if len(connections) >= most and (idle := _longest_idle(connections)) is not None:
        del connections[idle]
        idle.turn_away()
