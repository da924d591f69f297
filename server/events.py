"""What happens, told on standard error: a line an event, bounded a kind, and never waited for."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any, Literal, Self, TextIO

Form = Literal["text", "json"]

BURST, BURST_SECONDS = 10, 60.0
"""So many events of a kind are told within so long [s]; of more, the next one that is told has the count."""
_KINDS = 256
"""So many kinds are told apart; all others are one."""
_WAITING = 1000
"""So many lines may wait for whoever reads them; more are counted in the next one."""
_TEXT = logging.Formatter()


class Events:
    """Tells events on a stream, each as one line.

    As `json`, each is an object: `time`, `level`, `event`, whatever belongs to it, and `left_out` where some
    of its kind were not told. As `text`, warnings and errors alone, for people.

    A thread writes, so that no decision waits for a pipe that nobody empties.

    Args:
        form: json or text.
        stream: where to.
        clock: the time by which the bound is kept [s].
    """

    def __init__(
        self, form: Form = "text", stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._form = form
        self._stream = stream or sys.stderr
        self._clock = clock
        self._told: dict[str, deque[float]] = {}
        self._left_out: dict[str, int] = {}
        self._lines: deque[str] = deque()
        self._lock, self._some, self._ending = Lock(), Event(), Event()
        self._writer: Thread | None = None

    def tell(self, event: str, level: str = "info", **fields: Any) -> None:
        """Tells an event, unless there were too many of its kind; from any thread.

        Args:
            event: its kind.
            level: info, warning or error.
            **fields: what belongs to it, as plain JSON.
        """
        if self._form == "text" and level == "info":
            return
        with self._lock:
            kind = event if event in self._told or len(self._told) < _KINDS else "other"
            told = self._told.setdefault(kind, deque(maxlen=BURST))
            now = self._clock()
            full = len(told) == BURST and now - told[0] < BURST_SECONDS
            if full or len(self._lines) >= _WAITING:
                self._left_out[kind] = self._left_out.get(kind, 0) + 1
                return
            told.append(now)
            left_out = self._left_out.pop(kind, 0)
            more = {"left_out": left_out} if left_out else {}
            self._lines.append(self._line(event, level, fields | more))
        self._some.set()

    def __enter__(self) -> Self:
        """Starts to write, and takes over what the libraries and rooms log."""
        self._handler = _Logged(self)
        logging.getLogger().addHandler(self._handler)
        self._writer = Thread(target=self._write, name="events", daemon=True)
        self._writer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Writes what waits, unless nobody takes it within a second."""
        logging.getLogger().removeHandler(self._handler)
        self._ending.set()
        self._some.set()
        if self._writer is not None:
            self._writer.join(1.0)

    def _write(self) -> None:
        while not self._ending.is_set() or self._lines:
            self._some.wait()
            self._some.clear()
            # A stream that is closed ends the telling, never the service.
            with suppress(OSError, ValueError):
                while self._lines:
                    self._stream.write(self._lines.popleft() + "\n")
                self._stream.flush()
            if self._ending.is_set():
                self._some.set()

    def _line(self, event: str, level: str, fields: dict[str, Any]) -> str:
        if self._form == "json":
            head = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "level": level}
            return json.dumps(head | {"event": event} | fields, default=str)
        left_out = f" ({fields.pop('left_out')} more were left out)" if "left_out" in fields else ""
        if list(fields) == ["message", "trace"]:
            return f"{fields['message']}{left_out}" + (f"\n{fields['trace']}" if fields["trace"] else "")
        told = " ".join(f"{name}={value!r}" for name, value in fields.items())
        return f"{event}: {told}{left_out}"


class _Logged(logging.Handler):
    """Tells what is logged, as an event of the kind of its logger."""

    def __init__(self, events: Events) -> None:
        super().__init__(logging.WARNING)
        self._events = events

    def emit(self, record: logging.LogRecord) -> None:
        """Tells one record."""
        level = "error" if record.levelno >= logging.ERROR else "warning"
        trace = _TEXT.formatException(record.exc_info) if record.exc_info else None
        self._events.tell(record.name, level, message=record.getMessage(), trace=trace)
