"""What every command shares: its settings, its terminal, and how it ends."""

from command.line import INTERRUPTED, command, complain, hint, settings, terminal
from command.places import why_not_file, why_not_folder

__all__ = [
    "INTERRUPTED",
    "command",
    "complain",
    "hint",
    "settings",
    "terminal",
    "why_not_file",
    "why_not_folder",
]
