"""What is taken of a memory that a client brings back: what this service sealed, and a robot's last.

Memory travels with the robot, so that any of several services can decide next. A plan in it may be played
without another look at the world: one that is forged, or of another moment, would lead anywhere. So each
memory that leaves carries a number and a tag. What comes back with a wrong tag is lost. The service also
remembers each robot's last memory, so that an older one is told from it, and if the robot has a name, a
sensor that was caught stays caught though its robot forgets it.
"""

from __future__ import annotations

import hmac
import struct
import time
from hashlib import blake2b
from threading import Lock
from typing import NamedTuple

import numpy as np

from decision import MEMORY, PLAN_STEPS, Faults, Memory, fall_back, pack, unpack

MOST_ROBOTS = 4096
"""Robots whose last memory is remembered; of more, whoever asked longest ago goes, and last those that have a
sensor caught."""
KEY_BYTES = 32
"""Least length of a key, and that of one made at random."""

_STEP = 20_000_000
"""A control step [ns]: no robot has gone on by itself for more steps than have passed."""
_NUMBER = MEMORY.fields["seal"][1] if MEMORY.fields else 0
_FIRST, _TAG = _NUMBER + 8, _NUMBER + 16
Who = str | int
"""A robot by its name, or by the number of its first memory."""


class Past(NamedTuple):
    """What a robot's decision is to go by.

    Attributes:
        memory: (1,) its memory; None: it starts anew.
        lost: why what came is not to be trusted, else None.
        last: the memory that the service had sent it last, as far as is known.
    """

    memory: Memory | None
    lost: str | None
    last: bytes | None


class Keeper:
    """Seals memories, and looks through those that come back.

    Args:
        key: at least `KEY_BYTES`; whoever has it takes the others' seals for its own.
        faults: where memories that are not to be trusted are counted, under "memory".
    """

    def __init__(self, key: bytes, faults: Faults) -> None:
        self._key = blake2b(key).digest()
        self._faults = faults
        self._last: dict[Who, bytes] = {}
        self._lock = Lock()

    def past(self, text: str | None, played: int, robot: str | None, kind: str) -> Past:
        """What to go by for a robot that brings a memory, or none.

        Args:
            text: the memory as it came.
            played: for how many control steps the robot says that it has gone on by itself since.
            robot: the robot's name, if it told one.
            kind: what kind of robot it is, see `OnDuty.robot`: another kind's plans are not its own.
        """
        last = None if robot is None else self._last.get(robot)
        if text is None:
            return Past(None, None, None) if last is None else self._without(last, robot)
        try:
            memory = unpack(text)
        except ValueError as error:
            return self._lost(str(error), last)
        data = memory.tobytes()
        if not hmac.compare_digest(data[_TAG:], self._tag(data[:_TAG], kind, robot)):
            return self._lost("the memory is not one that this service sent", last)
        if robot is None:
            last = self._last.get(_word(data, _FIRST))
        if last is not None and _word(data, _NUMBER) < _word(last, _NUMBER):
            # It may not have had the last reply: what it has done since is not known.
            self._faults.note("memory", f"{robot or 'a robot'} came with an older memory than its last")
            return Past(_apart(last), None, last)
        return Past(_gone_on(memory, played) if played else memory, None, last)

    def seal(self, memory: np.void, robot: str | None, kind: str, past: Past) -> str:
        """A memory as it leaves, and is remembered.

        Args:
            memory: of the decision.
            robot: the robot's name, if it told one.
            kind: what kind of robot it is, see `OnDuty.robot`: another kind's plans are not its own.
            past: what the decision went by.
        """
        before, first = (0, 0) if past.memory is None else past.memory["seal"][0, :2].tolist()
        number = max(time.time_ns(), before + 1, 0 if past.last is None else _word(past.last, _NUMBER) + 1)
        who: Who = robot or first or number
        data = memory.tobytes()[:_NUMBER] + struct.pack("<qq", number, 0 if robot else who)
        data += self._tag(data, kind, robot)
        if who != number:  # whoever never brings a memory is nobody to remember
            self._remember(who, data, past.last)
        return pack(data)

    def forget(self, robot: str) -> bool:
        """Trusts a robot's sensors again, at its word that it starts anew; whether it was known."""
        with self._lock:
            return self._last.pop(robot, None) is not None

    def _tag(self, data: bytes, kind: str, robot: str | None) -> bytes:
        whose = "" if robot is None else robot
        return blake2b(data + f"{kind}\0{whose}".encode(), key=self._key, digest_size=16).digest()

    def _without(self, last: bytes, robot: str | None) -> Past:
        """A robot that is known comes without its memory: it starts anew, unless a sensor was caught."""
        if not _is_doubted(last):
            return Past(None, None, last)
        self._faults.note("memory", f"{robot} forgot that a sensor of it was caught")
        return Past(_apart(last), None, last)

    def _lost(self, why: str, last: bytes | None) -> Past:
        self._faults.note("memory", why)
        return Past(None if last is None else _apart(last), why, last)

    def _remember(self, who: Who, data: bytes, last: bytes | None) -> None:
        with self._lock:
            if self._last.get(who) is not last:
                return  # a later request was answered before this one
            self._last.pop(who, None)
            if len(self._last) >= MOST_ROBOTS:
                trusted = (name for name, known in self._last.items() if not _is_doubted(known))
                del self._last[next(trusted, next(iter(self._last)))]
            self._last[who] = data


def _word(data: bytes, place: int) -> int:
    word: int = struct.unpack_from("<q", data, place)[0]
    return word


def _is_doubted(data: bytes) -> bool:
    return bool(np.frombuffer(data, MEMORY)["history"]["doubted"][0] > 0)


def _apart(last: bytes) -> Memory:
    """A memory whose past is not compared with what comes: it need not be the robot's."""
    memory: Memory = np.frombuffer(bytearray(last), MEMORY)
    memory["history"]["age"] = 0
    return memory


def _gone_on(memory: Memory, played: int) -> Memory:
    """The memory of a robot that has played its plan by itself, for no longer than that can have taken."""
    passed = (time.time_ns() - int(memory["seal"][0, 0])) // _STEP
    after = _apart(memory.tobytes())
    for _ in range(min(played, passed, PLAN_STEPS)):
        after = fall_back(after, "").memory
    return after


class AsItComes(Keeper):
    """Takes every memory for what it says, and seals none: to decide again what was recorded."""

    def __init__(self) -> None:
        super().__init__(b"", Faults())

    def past(self, text: str | None, played: int, robot: str | None, kind: str) -> Past:
        """The memory as it came."""
        memory = None if text is None else unpack(text)
        return Past(_gone_on(memory, played) if memory is not None and played else memory, None, None)

    def seal(self, memory: np.void, robot: str | None, kind: str, past: Past) -> str:
        """A memory without number and tag."""
        return pack(memory.tobytes()[:_NUMBER] + bytes(MEMORY.itemsize - _NUMBER))
