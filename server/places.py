"""How many requests may await their decisions at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class FullError(RuntimeError):
    """There is no place for one more request."""


class Places:
    """Counts the requests that have come whole and await their decisions.

    Args:
        each: most of one client, by its address.
        all: most of all clients together.
    """

    def __init__(self, each: int, all: int) -> None:
        self._each = each
        self._all = all
        self._taken: Counter[str] = Counter()
        self._sum = 0

    @contextmanager
    def taken(self, client: str) -> Iterator[None]:
        """A place for a request of a client, until the context ends.

        Raises:
            FullError: if there is none.
        """
        if self._sum >= self._all:
            raise FullError(f"{self._sum} requests await their answers")
        if self._taken[client] >= self._each:
            raise FullError(f"{self._taken[client]} requests from this address await their answers")
        self._sum += 1
        self._taken[client] += 1
        try:
            yield
        finally:
            self._sum -= 1
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]
