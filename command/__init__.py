"""What every command shares: its settings, its terminal, and how it ends."""

from command.line import INTERRUPTED, command, complain, hint, settings, terminal
from command.places import why_not_file, why_not_folder
from command.progress import progress_bar

__all__ = [
    "INTERRUPTED",
    "command",
    "complain",
    "hint",
    "progress_bar",
    "settings",
    "terminal",
    "why_not_file",
    "why_not_folder",
]
