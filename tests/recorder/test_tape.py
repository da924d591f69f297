"""The files: bounded, readable wherever they break off, and whole or none when the disk is full."""

from __future__ import annotations

import errno
import itertools
from pathlib import Path

import pytest
from mcap.reader import make_reader

from recorder import RecordingError
from recorder.channels import TOPICS
from recorder.reading import Reader, Recorded
from recorder.tape import Folder, Recording, Tape

FILE = 200_000


def read(path: Path) -> tuple[Reader, list[Recorded]]:
    with Reader(path) as reader:
        return reader, list(reader.exchanges())


def write(path: Path, about, scribe, exchanges, every: int = 10) -> None:
    """A file of several chunks."""
    tape = Tape(path, about)
    for count, one in enumerate(exchanges, 1):
        tape.add(one, scribe.entries(one)[0])
        if count % every == 0:
            tape.flush()
    tape.close()


def test_what_is_written_is_read(tmp_path: Path, about, scribe, exchange) -> None:
    written = [exchange(number) for number in (1, 2, 3, 5, 6)]
    write(tmp_path / "a.mcap", about, scribe, written)
    reader, recorded = read(tmp_path / "a.mcap")
    assert (reader.ended, reader.damaged, reader.missing, reader.incident) == (True, 0, 1, None)
    assert reader.model["model"] == "tiny@0"
    for one, again in zip(written, recorded, strict=True):
        assert again[:5] == (one.number, one.received, one.sent, one.request, one.reply)
        assert [told["request"] for told in again.decisions] == [one.number]


def test_it_is_a_file_that_others_read(tmp_path: Path, about, scribe, exchange) -> None:
    write(tmp_path / "a.mcap", about, scribe, [exchange(number) for number in range(25)])
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert {channel.topic for channel in summary.channels.values()} == set(TOPICS)
        assert all(channel.message_encoding == "json" for channel in summary.channels.values())
        assert all(schema.encoding == "jsonschema" for schema in summary.schemas.values())
        assert summary.statistics.message_count == 25 * 4
        found = list(reader.iter_messages(topics="/decision"))
    assert [message.sequence for _, _, message in found] == list(range(25))


def test_files_and_their_sum_stay_below_their_bounds_and_the_oldest_go(
    tmp_path: Path, about, scribe, exchange
) -> None:
    folder = Folder(tmp_path, "recording", 5 * FILE)
    (tmp_path / "recording-other.txt").write_text("mine")
    recording = Recording(folder, about, FILE)
    numbers = itertools.count()
    seen: set[str] = set()
    while len(seen) < 12:
        one = exchange(next(numbers))
        recording.add(one, scribe.entries(one)[0])
        files = list(tmp_path.glob("*.mcap"))
        seen |= {file.name for file in files}
        assert sum(file.stat().st_size for file in files) <= 5 * FILE
    recording.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert sum(file.stat().st_size for file in files) <= 5 * FILE
    assert all(FILE / 2 < file.stat().st_size <= FILE for file in files[:-1])
    # What is left is the newest, without a gap, to the last one.
    kept = [recorded.number for file in files for recorded in read(file)[1]]
    assert kept == list(range(kept[0], next(numbers)))
    assert kept[0] > 0
    assert (tmp_path / "recording-other.txt").read_text() == "mine"


def test_an_exchange_larger_than_a_file_is_recorded_all_the_same(tmp_path, about, scribe, exchange) -> None:
    recording = Recording(Folder(tmp_path, "recording", 20 * FILE), about, FILE)
    large = exchange(2, reason="x" * (2 * FILE))
    for one in (exchange(1), large, exchange(3)):
        recording.add(one, scribe.entries(one)[0])
    recording.close()
    found = [recorded.reply for file in sorted(tmp_path.iterdir()) for recorded in read(file)[1]]
    assert found == [exchange(1).reply, large.reply, exchange(3).reply]


def test_a_file_that_another_service_is_writing_is_not_deleted(tmp_path, about, scribe, exchange) -> None:
    other = Tape(tmp_path / "recording-0.mcap", about)
    other.add(exchange(1), scribe.entries(exchange(1))[0])
    other.flush()
    (tmp_path / "recording-1.mcap").write_bytes(bytes(FILE))
    Folder(tmp_path, "recording", FILE).new(FILE)
    assert [file.name for file in tmp_path.iterdir()] == ["recording-0.mcap"]
    other.close()
    Folder(tmp_path, "recording", FILE).new(FILE)
    assert not list(tmp_path.iterdir())


def test_wherever_a_file_breaks_off_what_was_flushed_before_is_read(
    tmp_path: Path, about, scribe, exchange
) -> None:
    written = [exchange(number) for number in range(40)]
    write(tmp_path / "whole.mcap", about, scribe, written, every=10)
    whole = (tmp_path / "whole.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    counts = []
    for length in [*range(0, len(whole), 997), len(whole) - 1]:
        torn.write_bytes(whole[:length])
        try:
            reader, recorded = read(torn)
        except RecordingError:
            assert not counts
            continue
        assert not reader.ended
        assert [one.reply for one in recorded] == [one.reply for one in written[: len(recorded)]]
        assert len(recorded) % 10 == 0
        counts.append(len(recorded))
    assert counts == sorted(counts)
    assert set(counts) == {0, 10, 20, 30, 40}


def test_damage_costs_the_stretch_that_it_is_in(tmp_path: Path, about, scribe, exchange) -> None:
    written = [exchange(number) for number in range(40)]
    write(tmp_path / "a.mcap", about, scribe, written, every=10)
    whole = (tmp_path / "a.mcap").read_bytes()
    zstd = b"\x28\xb5\x2f\xfd"
    starts = [place for place in range(len(whole)) if whole.startswith(zstd, place)]
    assert len(starts) == 4
    for damaged, start in enumerate(starts):
        data = bytearray(whole)
        data[start + 500] ^= 0xFF
        (tmp_path / "a.mcap").write_bytes(data)
        reader, recorded = read(tmp_path / "a.mcap")
        assert (reader.damaged, reader.ended) == (1, True)
        kept = [number for number in range(40) if number // 10 != damaged]
        assert [one.number for one in recorded] == kept


@pytest.mark.parametrize(
    "content", [b"", b"PNG", bytes(1000), b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + b"\xff" * 99]
)
def test_another_file_is_no_recording(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.mcap: no recording of lagnet-serve"):
        Reader(tmp_path / "a.mcap")


class FullDisk:
    """A stream on a disk that has room for so many bytes."""

    def __init__(self, stream, room: int) -> None:
        self._stream, self._room = stream, room

    def write(self, data: bytes) -> int:
        self._room -= len(data)
        if self._room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._stream.write(data)

    def __getattr__(self, name: str):
        return getattr(self._stream, name)


def test_on_a_full_disk_it_raises_and_what_was_written_stays(tmp_path, about, scribe, exchange) -> None:
    tape = Tape(tmp_path / "a.mcap", about)
    tape._writer._Writer__stream = FullDisk(tape._stream, 30_000)
    with pytest.raises(OSError, match="No space left"):  # noqa: PT012
        for number in range(100):
            tape.add(exchange(number), scribe.entries(exchange(number))[0])
            tape.flush()
    reader, recorded = read(tmp_path / "a.mcap")
    assert not reader.ended
    assert 5 < len(recorded) < 100
    assert [one.number for one in recorded] == list(range(len(recorded)))
