"""What stands before every request, as pure ASGI: the keys, a place, and the limit on the body's size."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.keys import ACT, BATCH, STREAM, Keys, Level, needed
from server.origin import is_foreign, is_own

AT_ONCE = "lagnet.at_once"
"""The ASGI extension by which the server takes status and body of a JSON reply at once: True if it did."""
FULL = "lagnet.full"
"""The ASGI extension that says whether there is no place for one more robot."""
RETRY_AFTER = (b"retry-after", b"1")
"""Says when whoever found the service overloaded may try again [s]."""

_HANDSHAKE = "websocket.http.response"
"""What messages are called that answer a WebSocket's handshake with a reply."""
_MAX_DIGITS = 18


class BodyTooLargeError(ValueError):
    """A request's body is larger than the limit."""


class Guard:
    """Refuses requests without a key (401), with one for less (403), without a place (503), too large (413).

    Pages of other sites, by which a browser would ask for its user, are refused as well (403).

    Args:
        app: what it guards.
        keys: those that `Authorization: Bearer KEY` or `X-API-Key: KEY` may carry.
        max_body: most bytes of a request's body.
        larger: path → most bytes of a body there, where that is more.

    Attributes:
        refusals: status → requests refused here.
    """

    def __init__(
        self, app: ASGIApp, keys: Keys, max_body: int, larger: Mapping[str, int] | None = None
    ) -> None:
        self.refusals: Counter[int] = Counter()
        self._app = app
        self._keys = keys
        self._max_body = max_body
        self._larger = larger or {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers: dict[bytes, bytes] = dict(scope["headers"])
        if scope["type"] == "websocket":
            await self._stream(headers, scope, receive, send)
            return
        if (stranger := self._stranger(scope, headers)) is not None:
            await self._refuse(send, *stranger)
            return
        if scope["path"] in (ACT, BATCH) and scope.get("extensions", {}).get(FULL):
            await self._refuse(send, 503, "connection", "limit", "every connection awaits its answer")
            return
        max_body = self._larger.get(scope["path"], self._max_body)
        stated = headers.get(b"content-length", b"")
        # int() refuses thousands of digits.
        if stated.isdigit() and (len(stated) > _MAX_DIGITS or int(stated) > max_body):
            await self._refuse(send, 413, "body", "content-length", _too_large(max_body))
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
            message = f"the stream is at {STREAM}"
            await self._refuse(send, 404, "path", scope["path"], message, _HANDSHAKE)
        elif (stranger := self._stranger(scope, headers)) is not None:
            await self._refuse(send, *stranger, _HANDSHAKE)
        elif b"origin" in headers:
            # Browsers let any page open a stream to any host, and say whose page it is.
            message = "the stream is not for browsers"
            await self._refuse(send, 403, "header", "origin", message, _HANDSHAKE)
        else:
            await self._app(scope, receive, send)

    def is_robots(self, scope: Mapping[str, Any]) -> bool:
        """Whether a request is one that only a robot makes: for a decision, with the key."""
        if scope["path"] not in (ACT, BATCH, STREAM):
            return False
        return self._stranger(scope, dict(scope["headers"])) is None

    def _stranger(
        self, scope: Mapping[str, Any], headers: Mapping[bytes, bytes]
    ) -> tuple[int, str, str, str] | None:
        """Why whoever asks may not, as `_refuse` tells it."""
        # No browser sends a key by itself: where there is one, a name that leads here is of no use.
        if not self._keys.any and not is_own(headers.get(b"host", b"")):
            return 403, "header", "host", "without a key the service answers to localhost and addresses alone"
        wanted = needed(scope)
        if wanted and (granted := self._keys.granted(headers)) < wanted:
            status, message = self._not_allowed(granted, wanted)
            return status, "header", "authorization", message
        if is_foreign(scope.get("method", "GET"), headers):
            return 403, "header", "origin", "another site's page may not ask for this"
        return None

    def _not_allowed(self, granted: Level, wanted: Level) -> tuple[int, str]:
        if granted == Level.NOTHING:
            return 401, "a valid API key is required"
        if wanted == Level.ADMIN and self._keys.admin is None:
            return 403, "the service has no admin key"
        return 403, f"this takes the {wanted.name.lower()} key, not the {granted.name.lower()} key"

    async def _refuse(
        self, send: Send, status: int, place: str, name: str, message: str, kind: str = "http.response"
    ) -> None:
        self.refusals[status] += 1
        await _refuse(send, status, place, name, message, kind)


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
        headers.append(RETRY_AFTER)
    # The body was not read: the connection cannot carry another request.
    headers.append((b"connection", b"close"))
    await send({"type": f"{kind}.start", "status": status, "headers": headers})
    await send({"type": f"{kind}.body", "body": body})
