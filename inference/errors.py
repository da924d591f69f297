"""The exception of this room."""

from __future__ import annotations


class NetworkError(RuntimeError):
    """A network that could not be run, or gave something of another shape than its bundle promises."""
