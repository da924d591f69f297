"""One request with its reply, as the service hands it to the recorder."""

from __future__ import annotations

from typing import NamedTuple


class Exchange(NamedTuple):
    """A request for one or several decisions, and its reply; plain values, so that a pipe can carry it."""

    number: int
    """The service counts them; where one is missing, it was dropped."""
    received: int
    """When the request had come [ns since 1970]."""
    sent: int
    """When the reply was made [ns since 1970]."""
    client: tuple[str, int] | None
    """Address and port of who asked."""
    status: int
    """200, or 500 where the decision could not be told."""
    request: bytes
    """The request's body, byte for byte."""
    reply: bytes
    """The reply's body, byte for byte."""

    @property
    def size(self) -> int:
        """Its bytes."""
        return len(self.request) + len(self.reply)
