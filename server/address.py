"""Where services are, and what a client says and checks there."""

from __future__ import annotations

import ssl
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from server.session import ClientError

_SCHEMES = {"http": (80, False, False), "https": (443, True, False)}
_SCHEMES |= {"ws": (80, False, True), "wss": (443, True, True)}
"""Scheme → its port, whether it is verified, whether it is a stream."""


class Address(NamedTuple):
    """One service.

    Attributes:
        url: as it was given.
        host: its name or address.
        port: its port.
        headers: what every request there carries.
        tls: verifies it; None: the connection is plain.
        streams: whether decisions are asked for over `WS /act/stream`.
    """

    url: str
    host: str
    port: int
    headers: dict[str, str]
    tls: ssl.SSLContext | None
    streams: bool


def addresses(url: str | Sequence[str], api_key: str | None, ca_file: str | Path | None) -> list[Address]:
    """The services behind one URL or several.

    Raises:
        ClientError: if one is none, or the certificates cannot be read.
        ValueError: if the key is not printable ASCII.
    """
    headers = {"content-type": "application/json"}
    if api_key is not None:
        if not (api_key.isascii() and api_key.isprintable()):
            raise ValueError("the API key must be printable ASCII")
        headers["authorization"] = f"Bearer {api_key}"
    urls = [url] if isinstance(url, str) else list(url)
    if not urls:
        raise ClientError("no service was named")
    return [_address(each, headers, ca_file) for each in urls]


def _address(url: str, headers: dict[str, str], ca_file: str | Path | None) -> Address:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ClientError(f"{url}: {error}") from error
    if parts.scheme not in _SCHEMES or not host or parts.path not in ("", "/"):
        raise ClientError(f"{url}: expected {', '.join(_SCHEMES)}://HOST:PORT")
    usual, verified, streams = _SCHEMES[parts.scheme]
    try:
        tls = ssl.create_default_context(cafile=ca_file) if verified else None
    except OSError as error:
        raise ClientError(f"{ca_file}: no certificates can be read there: {error}") from error
    return Address(url, host, port or usual, headers, tls, streams)
