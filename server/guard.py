"""What stands before every request, as pure ASGI: the key, a place, and the limit on the body's size."""

from __future__ import annotations

import hmac
import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ACT, BATCH, STREAM = "/act", "/act/batch", "/act/stream"
OPEN_PATHS = frozenset({"/healthz", "/readyz"})
"""What an orchestrator may ask without a key."""
AT_ONCE = "lagnet.at_once"
"""The ASGI extension by which the server takes status and body of a JSON reply at once: True if it did."""
FULL = "lagnet.full"
"""The ASGI extension that says whether there is no place for one more robot."""

_HANDSHAKE = "websocket.http.response"
"""What messages are called that answer a WebSocket's handshake with a reply."""
_MAX_DIGITS = 18


class BodyTooLargeError(ValueError):
    """A request's body is larger than the limit."""


class Guard:
    """Refuses requests without the key (401), without a place (503) and with a body above the limit (413).

    Args:
        app: what it guards.
        api_key: the key that `Authorization: Bearer KEY` or `X-API-Key: KEY` must carry; None asks for none.
        max_body: most bytes of a request's body.
        larger: path → most bytes of a body there, where that is more.
    """

    def __init__(
        self, app: ASGIApp, api_key: str | None, max_body: int, larger: Mapping[str, int] | None = None
    ) -> None:
        self._app = app
        self._key = None if api_key is None else api_key.encode()
        self._max_body = max_body
        self._larger = larger or {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one connection."""
        headers: dict[bytes, bytes] = dict(scope["headers"])
        if scope["type"] == "websocket":
            await self._stream(headers, scope, receive, send)
            return
        if scope["path"] not in OPEN_PATHS and not self._admits(headers):
            await _refuse(send, 401, "header", "authorization", "a valid API key is required")
            return
        if scope["path"] in (ACT, BATCH) and scope.get("extensions", {}).get(FULL):
            await _refuse(send, 503, "connection", "limit", "every connection awaits its answer")
            return
        max_body = self._larger.get(scope["path"], self._max_body)
        stated = headers.get(b"content-length", b"")
        # int() refuses thousands of digits.
        if stated.isdigit() and (len(stated) > _MAX_DIGITS or int(stated) > max_body):
            await _refuse(send, 413, "body", "content-length", _too_large(max_body))
            return
        if not stated.isdigit() or b"transfer-encoding" in headers:
            receive = _limited(receive, max_body)
        # Who hangs up in the middle of a body gets no reply, and leaves no traceback in the log.
        with suppress(ClientDisconnect):
            await self._app(scope, receive, send)

    async def _stream(
        self, headers: Mapping[bytes, bytes], scope: Scope, receive: Receive, send: Send
    ) -> None:
        if scope["path"] != STREAM:
            await _refuse(send, 404, "path", scope["path"], f"the stream is at {STREAM}", _HANDSHAKE)
        elif not self._admits(headers):
            await _refuse(send, 401, "header", "authorization", "a valid API key is required", _HANDSHAKE)
        elif b"origin" in headers:
            # Browsers let any page open a stream to any host, and say whose page it is.
            await _refuse(send, 403, "header", "origin", "the stream is not for browsers", _HANDSHAKE)
        else:
            await self._app(scope, receive, send)

    def is_robots(self, scope: Mapping[str, Any]) -> bool:
        """Whether a request is one that only a robot makes: for a decision, with the key."""
        return scope["path"] in (ACT, BATCH, STREAM) and self._admits(dict(scope["headers"]))

    def _admits(self, headers: Mapping[bytes, bytes]) -> bool:
        return self._key is None or _carries(headers, self._key)


def _too_large(max_body: int) -> str:
    return f"the body must not exceed {max_body} bytes"


def _limited(receive: Receive, max_body: int) -> Receive:
    """Counts what comes of a body whose length was not stated."""
    received = 0

    async def limited() -> Message:
        nonlocal received
        message = await receive()
        if message["type"] == "http.request":
            received += len(message.get("body", b""))
            if received > max_body:
                raise BodyTooLargeError(_too_large(max_body))
        return message

    return limited


def _carries(headers: Mapping[bytes, bytes], key: bytes) -> bool:
    scheme, _, bearer = headers.get(b"authorization", b"").partition(b" ")
    given = bearer.strip() if scheme.lower() == b"bearer" else headers.get(b"x-api-key", b"")
    return hmac.compare_digest(given, key)


async def _refuse(
    send: Send, status: int, place: str, name: str, message: str, kind: str = "http.response"
) -> None:
    """Answers a request that is not read, and closes its connection."""
    detail = [{"loc": [place, name], "msg": message, "type": "refused"}]
    body = json.dumps({"detail": detail}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if status == 503:
        headers.append((b"retry-after", b"1"))
    # The body was not read: the connection cannot carry another request.
    headers.append((b"connection", b"close"))
    await send({"type": f"{kind}.start", "status": status, "headers": headers})
    await send({"type": f"{kind}.body", "body": body})
