"""The command line: settings from it, plain text to it, one line on an error, and an orderly end."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, TypeVar

import tyro
from rich.console import Console

Settings = TypeVar("Settings")
BROKEN_PIPE = 141
"""Exit status of a command whose reader went away, as a shell gives it."""
INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def terminal(stderr: bool = True, **options: Any) -> Console:
    """A console that prints text as it is: no markup in a user's names, and no line broken but by us.

    Args:
        stderr: whether it is standard error that is written to.
        options: further ones of `rich.console.Console`.
    """
    plain = {"markup": False, "emoji": False, "highlight": False, "soft_wrap": True}
    return Console(**{"stderr": stderr, **plain, **options})


def settings(kind: type[Settings], prog: str) -> Settings:
    """A command's settings from the command line; ends the program after ``--help`` and ``--version``.

    Args:
        kind: a dataclass, whose docstring says what the command does.
        prog: the command's name.
    """
    if "--version" in sys.argv[1:]:
        print(f"{prog} {version('lagnet')}")  # noqa: T201 - what was asked for
        sys.exit(0)
    about = f"{(kind.__doc__ or '').strip()}\n\n--version prints the version."
    return tyro.cli(kind, prog=prog, description=about)


@contextmanager
def command(prog: str, *failures: type[Exception], status: int = 2) -> Iterator[None]:
    """A command's whole run.

    Args:
        prog: its name.
        failures: what its user can act on: one line, and the program ends with ``status``.
        status: for those.
    """
    try:
        try:
            yield
        finally:
            # What is left in the buffer would fail only when the interpreter ends, with a traceback.
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(BROKEN_PIPE)
    except failures as error:
        complain(prog, error)
        sys.exit(status)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def complain(prog: str, error: object) -> None:
    """Says on standard error what went wrong."""
    terminal().print(f"{prog}: {error}", style="red")


def hint(*words: object) -> str:
    """A command to paste into a shell, whatever is in its words."""
    return shlex.join(str(word) for word in words)
