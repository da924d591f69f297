"""The exception of this room."""

from __future__ import annotations


class MonitorError(ValueError):
    """A monitor that must not be started: a wrong gate, threshold or observation layout."""
