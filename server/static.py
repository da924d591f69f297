"""The live page over HTTP: its files, which hold nothing secret, and the stream of what it shows."""

from __future__ import annotations

import hashlib
from importlib import resources
from importlib.resources.abc import Traversable

from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from server.keys import HOME, PAGE
from server.live import Hub

STREAM = "/live"
"""Where the page listens."""
_KINDS = {
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_FOREVER = "public, max-age=31536000, immutable"
_ASK = "no-cache"
_PLACE = "{files}"
"""Where the page's own address of its files stands in index.html."""


def routes(hub: Hub) -> list[Route]:
    """The page at `/`, its files below `/page`, and the stream.

    The files' addresses hold a hash of all of them, so that they are kept for as long as they are the same;
    the page itself is asked for anew.
    """
    files = _read(resources.files("server") / "page")
    digest = hashlib.sha256(b"".join(name.encode() + files[name] for name in sorted(files))).hexdigest()[:16]
    index = files["index.html"].replace(_PLACE.encode(), f"page/{digest}".encode())
    etag = f'"{digest}"'

    async def home(request: Request) -> Response:
        headers = _HEADERS | {"cache-control": _ASK, "etag": etag}
        if request.headers.get("if-none-match") == etag:
            return Response(status_code=304, headers=headers)
        return Response(index, headers=headers, media_type=_KINDS["html"])

    async def file(request: Request) -> Response:
        name = request.path_params["name"]
        kind = _KINDS.get(name.rpartition(".")[2])
        if request.path_params["digest"] != digest or name not in files or kind is None:
            return JSONResponse({"detail": "Not Found"}, status_code=404)
        return Response(files[name], headers=_HEADERS | {"cache-control": _FOREVER}, media_type=kind)

    async def live(request: Request) -> Response:
        if request.method == "HEAD":
            return Response(media_type="text/event-stream")
        if hub.full:
            detail = [{"loc": ["page"], "msg": "as many watch as may", "type": "refused"}]
            return JSONResponse({"detail": detail}, status_code=503, headers={"retry-after": "5"})
        # `no-transform` and `x-accel-buffering` keep proxies from holding events back.
        headers = {"cache-control": "no-store, no-transform", "x-accel-buffering": "no"}
        events = hub.stream(request.query_params.get("robot"))
        return StreamingResponse(events, headers=headers, media_type="text/event-stream")

    return [
        Route(HOME, home, include_in_schema=False),
        Route(f"{PAGE}{{digest}}/{{name:path}}", file, include_in_schema=False),
        Route(STREAM, live, methods=["GET"], include_in_schema=False),
    ]


def _read(folder: Traversable, below: str = "") -> dict[str, bytes]:
    """All files of a folder: name → what is in it."""
    found: dict[str, bytes] = {}
    for entry in folder.iterdir():
        name = below + entry.name
        found |= _read(entry, f"{name}/") if entry.is_dir() else {name: entry.read_bytes()}
    return found
