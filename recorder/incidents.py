"""The last half minute, kept in memory and written when something happens."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime

from recorder.channels import Entries, Scribe
from recorder.exchange import Exchange
from recorder.tape import About, Folder, Tape

RING_SECONDS = 30.0
"""How far back an incident's file goes [s]."""
AFTER_SECONDS = 5.0
"""For how long after its last cause an incident goes on [s]."""
MOST_SECONDS = 60.0
"""For how long after its first cause an incident's file is written [s]."""
_EXCERPT = 500


class Ring:
    """The last exchanges, bounded in time and in bytes.

    Args:
        most: bytes of requests and replies.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: deque[tuple[float, Exchange]] = deque()
        self._size = 0

    def add(self, exchange: Exchange, now: float) -> None:
        """Keeps an exchange, and lets go of what is too old or too much."""
        self._kept.append((now, exchange))
        self._size += exchange.size
        while self._kept and (self._size > self._most or now - self._kept[0][0] > RING_SECONDS):
            self._size -= self._kept.popleft()[1].size

    def clear(self) -> None:
        """Lets go of everything."""
        self._kept.clear()
        self._size = 0

    def exchanges(self, now: float) -> list[Exchange]:
        """What is kept of the last `RING_SECONDS`, in order."""
        return [exchange for at, exchange in self._kept if now - at <= RING_SECONDS]


class Incidents:
    """Writes a file for each incident: what came before it, and what follows while it lasts.

    An incident lasts while causes follow one another within `AFTER_SECONDS`; it has one file.

    Args:
        folder: where to.
        about: what decided.
        scribe: writes exchanges down.
        file_bytes: how large a file may become; half of it is for what came before.
        clock: the time [s].

    Attributes:
        count: how many there were.
        last: the name of the last one's file.
    """

    def __init__(
        self,
        folder: Folder,
        about: About,
        scribe: Scribe,
        file_bytes: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._about, self._scribe = folder, about, scribe
        self._file_bytes = file_bytes
        self._clock = clock
        self._ring = Ring(file_bytes // 2)
        self._tape: Tape | None = None
        self._began = self._until = -math.inf
        self.count = 0
        self.last: str | None = None

    def add(self, exchange: Exchange, entries: Entries) -> None:
        """Keeps an exchange, and writes it if there is an incident.

        Raises:
            OSError: if it cannot be written. So do the other methods.
        """
        now = self._clock()
        self._ring.add(exchange, now)
        if self._tape is not None:
            if now > min(self._until, self._began + MOST_SECONDS) or self._is_full(entries):
                self.close()
            else:
                self._tape.add(exchange, entries)

    def happened(self, why: str, at: int) -> None:
        """Something has happened: writes a new file, unless the incident has one.

        Args:
            why: what.
            at: when [ns since 1970].
        """
        now = self._clock()
        same, self._until = now <= self._until, now + AFTER_SECONDS
        if same:
            return
        self.close()
        self._began = now
        told = {
            "reason": why[:_EXCERPT],
            "at": str(at),
            "utc": datetime.fromtimestamp(at / 1e9, UTC).isoformat(),
        }
        tape = Tape(self._folder.new(self._file_bytes), self._about, told)
        for exchange in self._ring.exchanges(now):
            tape.add(exchange, self._scribe.entries(exchange)[0])
        tape.flush()
        self._tape = tape
        self.count, self.last = self.count + 1, tape.path.name

    def change(self, about: About, at: int) -> None:
        """Another one decides: what is kept of the one before is written, and nothing of it is kept.

        Args:
            about: what decides now.
            at: when [ns since 1970].
        """
        self.happened("another bundle took over", at)
        self.close()
        self._ring.clear()
        self._about, self._until = about, -math.inf

    def flush_if_due(self) -> None:
        """Writes what has waited for long enough, and ends the file of an incident that is over."""
        if self._tape is None:
            return
        if self._clock() > min(self._until, self._began + MOST_SECONDS):
            self.close()
        else:
            self._tape.flush_if_due()

    def close(self) -> None:
        """Ends the file."""
        if self._tape is not None:
            tape, self._tape = self._tape, None
            tape.close(lasting=True)

    def _is_full(self, entries: Entries) -> bool:
        size = sum(len(data) + 64 for _, data in entries)
        return self._tape is not None and self._tape.size + size > self._file_bytes
