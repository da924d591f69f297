"""The exception of this room."""

from __future__ import annotations


class RecordingError(ValueError):
    """A recording that cannot be started, or a file that is none."""
