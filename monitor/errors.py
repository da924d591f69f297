"""The exceptions of this room."""

from __future__ import annotations


class MonitorError(ValueError):
    """A monitor that must not be started: a wrong gate, threshold or observation layout."""


class NetworkError(RuntimeError):
    """A network that could not be run, or gave something of another shape than its bundle promises."""
