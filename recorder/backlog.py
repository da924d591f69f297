"""What waits to be handed on to the recorder's process, in memory that goes back to the system.

Where that process falls behind, tens of megabytes wait, a few kilobytes a request. In the interpreter's heap
they would lie between what stays, and the heap would never shrink again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from mmap import mmap
from threading import Lock
from typing import Any

from recorder.frames import frame

_BLOCK = 1 << 20


class _Block:
    """Frames one after the other, in pages of their own."""

    __slots__ = ("filled", "pages")

    def __init__(self, size: int) -> None:
        self.pages = mmap(-1, size)
        self.filled = 0

    def fits(self, data: bytes) -> bool:
        return self.filled + len(data) <= len(self.pages)

    def add(self, data: bytes) -> None:
        end = self.filled + len(data)
        self.pages[self.filled : end] = data
        self.filled = end

    def hand_on(self, write: Callable[[memoryview], None]) -> None:
        with memoryview(self.pages) as pages, pages[: self.filled] as data:
            write(data)
        self.pages.close()


class Backlog:
    """Values that wait, in order, as frames; put from any thread, handed on by one.

    Args:
        most: bytes that may wait.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._size = 0
        self._blocks: deque[_Block] = deque()
        self._lock = Lock()

    @property
    def size(self) -> int:
        """Bytes that wait, those that are being handed on included."""
        return self._size

    def put(self, value: Any, always: bool = False) -> bool:
        """Has a value wait, see `frame`; False if there is no room for it.

        Args:
            value: what is to be handed on.
            always: whether it waits even where there is no room.
        """
        data = frame(value)
        with self._lock:
            if self._size + len(data) > self._most and not always:
                return False
            if not self._blocks or not self._blocks[-1].fits(data):
                self._blocks.append(_Block(max(_BLOCK, len(data))))
            self._blocks[-1].add(data)
            self._size += len(data)
        return True

    def hand_on(self, write: Callable[[memoryview], None]) -> bool:
        """Hands on what has waited longest, about a megabyte at once; False if nothing waits.

        Args:
            write: takes whole frames; it must not keep them.
        """
        with self._lock:
            if not self._blocks:
                return False
            block = self._blocks.popleft()
        block.hand_on(write)
        with self._lock:
            self._size -= block.filled
        return True

    def clear(self) -> None:
        """Forgets whatever waits."""
        with self._lock:
            self._blocks.clear()
            self._size = 0
