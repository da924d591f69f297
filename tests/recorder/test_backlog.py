"""What waits for the recorder's process: in order, bounded, and its memory given back."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from recorder.backlog import Backlog
from recorder.frames import frames


def handed_on(backlog: Backlog) -> list[Any]:
    pipe = io.BytesIO()

    def write(data: memoryview) -> None:
        pipe.write(data)

    while backlog.hand_on(write):
        pass
    pipe.seek(0)
    return list(frames(pipe))


def test_what_was_put_comes_out_in_order_whatever_its_size() -> None:
    backlog = Backlog(64 << 20)
    values = [[k, b"x" * size] for k, size in enumerate((0, 10, 700_000, 700_000, 3 << 20, 5, 1 << 20))]
    assert all(backlog.put(value) for value in values)
    assert handed_on(backlog) == values
    assert backlog.size == 0
    assert handed_on(backlog) == []


def test_beyond_the_bound_nothing_waits_but_what_must_not_be_lost() -> None:
    backlog = Backlog(1000)
    taken = [backlog.put(b"x" * 300) for _ in range(5)]
    assert taken == [True] * 3 + [False] * 2
    assert backlog.put("an alarm", always=True)
    held: list[bool] = []
    # While it is on its way it still takes its room.
    assert backlog.hand_on(lambda data: held.append(backlog.put(b"x" * 300)))
    assert held == [False]
    assert backlog.size == 0
    assert backlog.put(b"x" * 300)
    backlog.clear()
    assert (backlog.size, handed_on(backlog)) == (0, [])


def resident() -> float:
    [size] = re.findall(r"^VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(size) / 1e3


@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_the_memory_of_what_waited_goes_back_though_other_things_stay() -> None:
    """In the heap, what stays between the bodies would keep all of it."""
    backlog, stays = Backlog(64 << 20), []
    before = resident()
    for k in range(16_000):
        assert backlog.put((k, bytes(3000)))
        stays.append(bytes(600))
    assert resident() > before + 45.0
    while backlog.hand_on(lambda data: None):
        pass
    assert resident() < before + 25.0
    assert len(stays) == 16_000
