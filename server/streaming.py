"""The connections of `WS /act/stream`."""

from __future__ import annotations

import math
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from server.door import MAX_AHEAD, Bounded

_TRY_AGAIN_LATER = 1013
_POLICY_VIOLATION = 1008


class StreamConnection(Bounded, WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, with a deadline."""

    _ahead = 0
    """Frames that have come and are not answered yet."""

    @property
    def awaits_answer(self) -> bool:
        """Whether a whole frame has come and is not answered yet."""
        return self._ahead > 0

    def data_received(self, data: bytes) -> None:
        """Some bytes have come."""
        ahead = self._ahead
        super().data_received(data)
        if self._ahead == ahead and self.handshake_complete and not self._reading:
            self._reading = True
            if not self._ahead:
                self._allow(self._door.patience.read)

    def handle_ping(self) -> None:
        """A sign of life, unless it comes in the middle of a message."""
        super().handle_ping()
        if not self.frames and not self._ahead:
            self._reading = False
            self._allow(self._door.patience.idle)

    def send_receive_event_to_app(self) -> None:
        """A frame has come whole: from here on it is we who are slow."""
        if self.close_sent:
            return
        if self._door.full(self):
            self._close(_TRY_AGAIN_LATER, "every connection awaits its answer")
            return
        if self._ahead >= MAX_AHEAD:
            self._close(_POLICY_VIOLATION, "too many frames ahead of their answers")
            return
        self._reading = False
        self._ahead += 1
        self._allow(math.inf)
        self._door.heard(self, self.scope)
        # uvicorn would stop reading after every frame and start again: two system calls each.
        self.read_paused = True
        super().send_receive_event_to_app()

    async def receive(self) -> Any:
        """The next frame."""
        self.read_paused = False
        return await super().receive()

    async def send(self, message: Any) -> None:
        """An answer is on its way."""
        await super().send(message)
        if message["type"] == "websocket.send":
            self._ahead -= 1
        if not self._ahead:
            self._allow(self._door.patience.read if self._reading else self._door.patience.idle)

    def turn_away(self) -> None:
        """Closes the connection."""
        if self.transport.is_closing() or self.transport.get_write_buffer_size():
            self.transport.abort()
            return
        self._close(_POLICY_VIOLATION, "silent or too slow")

    def _close(self, code: int, why: str) -> None:
        if self.handshake_complete and not self.close_sent:
            self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": why})
            self.conn.send_close(code, why)
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.close_sent = True
        self.transport.close()
