"""Threads that decide, each decision within a deadline, while the event loop goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Any, Generic, TypeVar

MOST_HUNG = 4
"""Most threads that may hang in a decision; where so many do, no further one is begun."""

Made = TypeVar("Made")


class LateError(TimeoutError):
    """A decision was not made in time."""


@dataclass(eq=False)
class _Job(Generic[Made]):
    """Something to be made.

    Attributes:
        make: makes it.
        made: told of what came of it, in `loop`.
        loop: whose it is.
        begun: whether a thread is at it.
        ended: whether it is made, whatever came of it.
        late: whether nobody waits for it any more.
    """

    make: Callable[[], Made]
    made: asyncio.Future[Made]
    loop: asyncio.AbstractEventLoop
    begun: bool = False
    ended: bool = False
    late: bool = False


class Hands:
    """One thread that decides, and another in its place while it hangs.

    No thread can be made to stop: one that is not done at its deadline is left to itself. What it still comes
    to is dropped, whoever it was for, and it decides again only if there is work for it when it is done.

    Args:
        deadline: how long a decision may take, what it waits for its turn included [s]; None: as long as it
            likes.
        most: most threads that may hang.
    """

    def __init__(self, deadline: float | None = None, most: int = MOST_HUNG) -> None:
        self.deadline = deadline
        self._most = most
        self._jobs: SimpleQueue[_Job[Any]] = SimpleQueue()
        self._numbers = count()
        self._lock = Lock()
        self._threads = 0
        self._hung = 0

    @property
    def hung(self) -> int:
        """How many threads hang in a decision whose deadline has passed."""
        return self._hung

    async def make(self, make: Callable[[], Made]) -> Made:
        """What `make` comes to, made in a thread.

        Raises:
            LateError: at the deadline, or at once while as many threads hang as may.
        """
        loop = asyncio.get_running_loop()
        job: _Job[Made] = _Job(make, loop.create_future(), loop)
        with self._lock:
            if self._hung >= self._most:
                raise LateError(f"{self._hung} decisions hang")
            self._jobs.put(job)
            self._staff()
        timer = None if self.deadline is None else loop.call_later(self.deadline, self._expire, job)
        try:
            made: Made = await job.made
            return made
        finally:
            if timer is not None:
                timer.cancel()

    def _staff(self) -> None:
        """Sees to it that one thread does not hang, if that may be."""
        if self._threads == self._hung < self._most:
            self._threads += 1
            # A daemon: one that hangs must not keep the service from ending.
            Thread(target=self._work, name=f"decisions-{next(self._numbers)}", daemon=True).start()

    def _expire(self, job: _Job[Any]) -> None:
        """The deadline of a job has come."""
        with self._lock:
            if job.ended or job.made.done():
                return
            job.late = True
            if job.begun:
                self._hung += 1
                self._staff()
        job.made.set_exception(LateError(f"no decision within {1e3 * (self.deadline or 0.0):g} ms"))

    def _work(self) -> None:
        """Takes job after job; ends once another thread has taken its place."""
        while True:
            job = self._jobs.get()
            with self._lock:
                if job.late:
                    continue
                job.begun = True
            made: Any = None
            error: BaseException | None = None
            try:
                made = job.make()
            except BaseException as caught:  # noqa: BLE001 - whoever waits for it is told
                error = caught
            with self._lock:
                job.ended = True
                if job.late:
                    self._hung -= 1
                    if self._threads - self._hung > 1:
                        self._threads -= 1
                        return
                    continue
            with suppress(RuntimeError):  # its loop is closed: nobody waits any more
                job.loop.call_soon_threadsafe(_deliver, job, made, error)


def _deliver(job: _Job[Any], made: Any, error: BaseException | None) -> None:
    """Tells whoever waits, if somebody still does."""
    if job.made.done():
        return
    if error is None:
        job.made.set_result(made)
    else:
        job.made.set_exception(error)
