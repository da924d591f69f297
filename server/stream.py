"""The robot's end of `WS /act/stream`: a link whose requests and replies are frames.

Frames are written and read here: a library that reads in a thread of its own would cost more than the rest of
the exchange, and would not know of the deadline.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import http.client
import os
import struct

from server.link import MAX_REPLY, Connected, Link, remaining

_MAGIC = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
"""RFC 6455, section 1.3."""
_STATUS = b'{"status":'
TEXT, BINARY, _PING, _PONG = 0x1, 0x2, 0x9, 0xA
_FINAL = 0x80
_LONGEST_CONTROL = 125


class StreamLink(Link):
    """A link over one WebSocket, which is opened after the service has said what it runs."""

    def _open(self, deadline: float) -> Connected:
        opened = super()._open(deadline)
        key = base64.b64encode(os.urandom(16))
        head = (
            f"GET /act/stream HTTP/1.1\r\n{self._headers}connection: Upgrade\r\nupgrade: websocket\r\n"
            f"sec-websocket-version: 13\r\nsec-websocket-key: {key.decode()}\r\n\r\n"
        )
        opened.deadline, opened.allowance = deadline, MAX_REPLY
        opened.settimeout(remaining(deadline))
        opened.sendall(head.encode("latin-1"))
        status, headers = _head(opened)
        accept = base64.b64encode(hashlib.sha1(key + _MAGIC, usedforsecurity=False).digest())
        told = headers.get("sec-websocket-accept", "").encode()
        if status != http.client.SWITCHING_PROTOCOLS or not hmac.compare_digest(told, accept):
            raise http.client.HTTPException(f"/act/stream answered {status}, and is no stream")
        return opened

    def _transfer(
        self, opened: Connected, method: str, path: str, body: bytes, deadline: float
    ) -> tuple[int, bytes]:
        """One frame each way."""
        opened.deadline, opened.allowance = deadline, MAX_REPLY
        opened.settimeout(remaining(deadline))
        opened.sendall(frame(TEXT, body))
        while True:
            kind, content = _read_frame(opened)
            if kind == _PING:
                opened.settimeout(remaining(deadline))
                opened.sendall(frame(_PONG, content))
            elif kind == TEXT:
                return _status_of(content), content
            elif kind != _PONG:
                raise http.client.HTTPException("the service closed the stream")


def _status_of(content: bytes) -> int:
    """A frame that is no reply begins with its status."""
    if not content.startswith(_STATUS):
        return http.client.OK
    digits = content[len(_STATUS) : len(_STATUS) + 3]
    return int(digits) if digits.isdigit() else http.client.BAD_GATEWAY


def _head(opened: Connected) -> tuple[int, dict[str, str]]:
    response = http.client.HTTPResponse(opened, method="GET")
    try:
        response.begin()
        return response.status, {name.lower(): value for name, value in response.getheaders()}
    finally:
        response.close()


def frame(kind: int, content: bytes) -> bytes:
    """A whole frame; a client's are masked (RFC 6455, section 5.3)."""
    size = len(content)
    if size <= _LONGEST_CONTROL:
        head = struct.pack("!BB", _FINAL | kind, 0x80 | size)
    elif size < 65536:
        head = struct.pack("!BBH", _FINAL | kind, 0x80 | 126, size)
    else:
        head = struct.pack("!BBQ", _FINAL | kind, 0x80 | 127, size)
    mask = os.urandom(4)
    whole = mask * (size // 4 + 1)
    # As one large number each: a loop over bytes would take longer than the decision.
    masked = int.from_bytes(content) ^ int.from_bytes(whole[:size])
    return head + mask + masked.to_bytes(size)


def _read_frame(opened: Connected) -> tuple[int, bytes]:
    """The next whole frame.

    Raises:
        http.client.HTTPException: for a frame in parts, one that is masked, or one that is too long.
    """
    first, size = _read(opened, 2)
    if size == 126:
        (size,) = struct.unpack("!H", _read(opened, 2))
    elif size == 127:
        (size,) = struct.unpack("!Q", _read(opened, 8))
    if not first & _FINAL or first & 0x70 or size > MAX_REPLY or (first & 0x8 and size > _LONGEST_CONTROL):
        raise http.client.HTTPException("the stream has a frame that no service sends")
    return first & 0x0F, _read(opened, size)


def _read(opened: Connected, size: int) -> bytes:
    content = bytearray(size)
    view, have = memoryview(content), 0
    while have < size:
        count = opened.recv_into(view[have:], size - have)
        if not count:
            raise ConnectionResetError("the service closed the connection")
        have += count
    return bytes(content)
