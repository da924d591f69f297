"""Whether something can be written somewhere: asked before long work, not after it."""

from __future__ import annotations

import os
from pathlib import Path


def why_not_file(path: Path) -> str | None:
    """Why a file cannot be written there, or None; the folder that it goes to must exist."""
    if path.is_dir():
        return "is a folder"
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}"
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        return "cannot be written: Permission denied"
    return None


def why_not_folder(path: Path) -> str | None:
    """Why a new folder cannot be made there, with those above it that are missing, or None."""
    if path.exists() and not path.is_dir():
        return "is a file"
    above = path
    while not above.exists():
        above = above.parent
    if not above.is_dir():
        return f"{above} is not a folder"
    if not os.access(above, os.W_OK | os.X_OK):
        return f"cannot be made: {above}: Permission denied"
    return None
