"""What went wrong at run time: counted, and logged once a kind a minute."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from threading import Lock
from typing import Any

_QUIET = 60.0
"""How long a kind of fault is not logged again, and how long an internal one is remembered [s]."""


class Faults:
    """The faults of one monitor, or of one client.

    Args:
        logger: the name of the logger that they go to.

    Attributes:
        counts: kind → how many there were.
    """

    def __init__(self, logger: str = "lagnet.monitor") -> None:
        self.counts: Counter[str] = Counter()
        self._logger = logging.getLogger(logger)
        self._logged: dict[str, float] = {}
        self._internal: deque[float] = deque(maxlen=1000)
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=Lock())

    def note(
        self, kind: str, message: str, error: BaseException | None = None, internal: bool = True
    ) -> None:
        """Count a fault, and log it if its kind was not logged for a minute.

        Args:
            kind: what it is counted under: "bad input", "network", or an exception's class.
            message: what happened.
            error: what was caught, for an internal fault: its traceback is logged.
            internal: False where decisions do not hang on what failed.
        """
        now = time.monotonic()
        with self._lock:
            self.counts[kind] += 1
            if error is not None and internal:
                self._internal.append(now)
            due = now - self._logged.get(kind, -_QUIET) >= _QUIET
            if due:
                self._logged[kind] = now
        if due:
            self._logger.warning("%s (%d so far): %s", kind, self.counts[kind], message, exc_info=error)

    def internal(self) -> int:
        """How many internal faults the last minute had, a thousand at most."""
        now = time.monotonic()
        with self._lock:
            return sum(now - at < _QUIET for at in self._internal)
