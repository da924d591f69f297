"""Another bundle takes over while the service runs: checked and warmed up first, or refused."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from models import BundleError
from monitor import Monitor, MonitorError
from server.duty import SAME
from server.operation import Operation
from server.schema import ModelReply

SWITCH_SECONDS = 1e-4
"""How long a thread keeps the interpreter from decisions while it loads a bundle [s]; usually 5 ms."""
Load = Callable[[Path], Monitor]
"""Loads a bundle with the service's settings, and warms it up."""


class ChangeError(ValueError):
    """A bundle that does not take over; the one before serves on."""


class BusyError(ChangeError):
    """Another one is being loaded."""


class Changer:
    """Changes the bundle.

    Args:
        operation: the service's.
        load: loads a bundle with its settings.
        path: the bundle that it was started with; a link is followed anew each time.
        folder: where all others lie; None: there are none.
    """

    def __init__(self, operation: Operation, load: Load, path: Path, folder: Path | None = None) -> None:
        self._operation = operation
        self._load = load
        self._path = path
        self._folder = folder
        self._thread = ThreadPoolExecutor(1, "bundles")
        self._busy = False

    @property
    def allows_names(self) -> bool:
        """Whether there is a folder with other bundles."""
        return self._folder is not None

    async def again(self) -> ModelReply:
        """Loads what the service's own path points to now; returns and raises as `to`."""
        return await self._change(self._path)

    async def to(self, name: str) -> ModelReply:
        """Loads a bundle, and has it take over.

        Args:
            name: its path below the folder.

        Returns:
            What it tells of itself.

        Raises:
            ChangeError: saying why it does not; nothing is changed then.
        """
        return await self._change(self._below(name))

    def _below(self, name: str) -> Path:
        if self._folder is None:
            raise ChangeError("the service was started without --bundles: it has no other bundles")
        try:
            folder = self._folder.resolve(strict=True)
            path = (folder / name).resolve(strict=True)
        except (OSError, ValueError, RuntimeError) as error:  # a link to itself, a NUL
            raise ChangeError(f"bundle: no such folder below --bundles: {name!r}") from error
        # Links are followed first: none leads out of the folder.
        if not path.is_relative_to(folder) or path == folder or not path.is_dir():
            raise ChangeError(f"bundle: no such folder below --bundles: {name!r}")
        return path

    async def _change(self, path: Path) -> ModelReply:
        if self._busy:
            raise BusyError("another bundle is being loaded")
        self._busy = True
        usual = sys.getswitchinterval()
        sys.setswitchinterval(min(usual, SWITCH_SECONDS))
        try:
            loop = asyncio.get_running_loop()
            monitor = await loop.run_in_executor(self._thread, self._load, path)
            self._check(ModelReply.of(monitor))
        except (BundleError, MonitorError, ChangeError) as error:
            self._operation.events.tell("bundle refused", "error", reason=str(error))
            raise ChangeError(str(error)) from error
        except Exception as error:
            # Whatever is wrong with it, the one before serves on.
            self._operation.events.tell("bundle refused", "error", reason=f"{type(error).__name__}: {error}")
            raise ChangeError(f"it cannot be loaded ({type(error).__name__})") from error
        finally:
            sys.setswitchinterval(usual)
            self._busy = False
        return self._operation.take_over(monitor)

    def _check(self, new: ModelReply) -> None:
        old = self._operation.duty.now.model
        for name in SAME:
            if getattr(new, name) != getattr(old, name):
                raise ChangeError(f"{new.model}: its {name} is not that of {old.model}")
