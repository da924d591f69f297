"""The one exception of this room."""

from __future__ import annotations


class BundleError(ValueError):
    """A bundle that must not be used; the message is one line and names the file and the field."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
