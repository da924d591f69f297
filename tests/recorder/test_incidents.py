"""The ring, and the files of incidents."""

from __future__ import annotations

from pathlib import Path

import pytest

from recorder.incidents import AFTER_SECONDS, MOST_SECONDS, RING_SECONDS, Incidents, Ring
from recorder.reading import Reader
from recorder.tape import Folder

FILE = 4_000_000
PACE = 0.25


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def incidents(tmp_path: Path, about, scribe, clock: Clock) -> Incidents:
    return Incidents(Folder(tmp_path, "incident", 10 * FILE), about, scribe, FILE, clock)


def files(folder: Path) -> list[tuple[str, list[int]]]:
    """Reason and numbers of each file."""
    found = []
    for path in sorted(folder.iterdir()):
        with Reader(path) as reader:
            found.append((reader.incident["reason"], [one.number for one in reader.exchanges()]))
    return found


def test_the_ring_keeps_half_a_minute(exchange) -> None:
    ring = Ring(FILE)
    for number in range(400):
        ring.add(exchange(number), number * PACE)
    kept = [one.number for one in ring.exchanges(399 * PACE)]
    assert kept == list(range(399 - int(RING_SECONDS / PACE), 400))
    assert ring.exchanges(399 * PACE + 2 * RING_SECONDS) == []


def test_the_ring_is_bounded_in_bytes(exchange) -> None:
    size = exchange(1).size
    ring = Ring(10 * size)
    for number in range(400):
        ring.add(exchange(number), 0.001 * number)
    kept = [one.number for one in ring.exchanges(0.4)]
    assert 8 <= len(kept) <= 11
    assert kept == list(range(400 - len(kept), 400))
    assert sum(one.size for one in ring.exchanges(0.4)) <= 10 * size
    ring.add(exchange(0, reason="x" * (11 * size)), 0.5)
    assert ring.exchanges(0.5) == []


class Run:
    """A service that answers every quarter of a second."""

    def __init__(self, incidents: Incidents, clock: Clock, scribe, exchange) -> None:
        self.incidents, self.clock, self.scribe, self.exchange = incidents, clock, scribe, exchange
        self.number = 0

    def seconds(self, seconds: float, happening: str | None = None) -> None:
        for _ in range(round(seconds / PACE)):
            one = self.exchange(self.number)
            self.incidents.add(one, self.scribe.entries(one)[0])
            if happening is not None:
                self.incidents.happened(happening, one.received)
            self.incidents.flush_if_due()
            self.number += 1
            self.clock.now += PACE


def test_a_file_has_what_came_before_and_what_follows(
    tmp_path: Path, incidents, clock, scribe, exchange
) -> None:
    run = Run(incidents, clock, scribe, exchange)
    run.seconds(100.0)
    assert not list(tmp_path.iterdir())
    run.seconds(PACE, "first")
    cause = run.number - 1
    # At once: not only when it is over.
    assert files(tmp_path)[0] == ("first", list(range(cause - int(RING_SECONDS / PACE), cause + 1)))
    run.seconds(20.0)
    [(reason, numbers)] = files(tmp_path)
    assert reason == "first"
    after = int(AFTER_SECONDS / PACE)
    assert numbers == list(range(cause - int(RING_SECONDS / PACE), cause + after + 1))
    assert incidents.last == next(tmp_path.iterdir()).name


def test_causes_that_follow_one_another_have_one_file_and_it_does_not_grow_for_ever(
    tmp_path: Path, incidents, clock, scribe, exchange
) -> None:
    run = Run(incidents, clock, scribe, exchange)
    run.seconds(3.0)
    for _ in range(60):  # every four seconds, for four minutes
        run.seconds(PACE, "again")
        run.seconds(4.0 - PACE)
    [(reason, numbers)] = files(tmp_path)
    assert reason == "again"
    assert numbers == list(range(int((3.0 + MOST_SECONDS) / PACE) + 1))
    # Once it has been quiet for long enough, the next one is another.
    run.seconds(AFTER_SECONDS + 1.0)
    run.seconds(PACE, "another")
    assert [reason for reason, _ in files(tmp_path)] == ["again", "another"]
    assert incidents.count == 2
    incidents.close()


def test_it_ends_though_nobody_asks_any_more(tmp_path: Path, incidents, clock, scribe, exchange) -> None:
    run = Run(incidents, clock, scribe, exchange)
    run.seconds(1.0, "it")
    clock.now += AFTER_SECONDS + 1.0
    incidents.flush_if_due()
    with Reader(next(tmp_path.iterdir())) as reader:
        assert len(list(reader.exchanges())) == 4
        assert reader.ended


def test_something_may_happen_before_anything_was_asked(tmp_path: Path, incidents) -> None:
    incidents.happened("an alarm " * 1000, 5)
    incidents.close()
    with Reader(next(tmp_path.iterdir())) as reader:
        assert reader.incident["at"] == "5"
        assert 100 < len(reader.incident["reason"]) < 1000
        assert list(reader.exchanges()) == []


def test_the_files_are_bounded(tmp_path: Path, about, scribe, clock, exchange) -> None:
    small = 100_000
    incidents = Incidents(Folder(tmp_path, "incident", 4 * small), about, scribe, small, clock)
    run = Run(incidents, clock, scribe, exchange)
    for round_ in range(12):
        run.seconds(30.0)
        run.seconds(5.0, f"incident {round_}")
        run.seconds(2 * AFTER_SECONDS)
        sizes = [path.stat().st_size for path in tmp_path.iterdir()]
        assert max(sizes) <= small
        assert sum(sizes) <= 4 * small
    found = files(tmp_path)
    assert found[-1][0] == "incident 11"
    assert len(found) >= 3
