"""MCAP files: one, and a folder of them that is bounded in size."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType, Writer

from recorder.channels import TOPICS, Entries, encoded, schemas
from recorder.exchange import Exchange

FLUSH_SECONDS = 0.4
"""How long a message may wait before it is written [s]."""
ABOUT, INCIDENT = "lagnet", "incident"
"""Names of the metadata in a file: what decided, and why there is a file of an incident."""

_CHUNK = 1 << 20
"""Bytes after which a chunk is written before it is due."""
_INDEX = 256
"""Bytes at the file's end for each chunk, at most."""
_ENDS = 32768
"""Bytes of all else at a file's end, at most."""

About = Mapping[str, Any]
"""What decided: `model` as `GET /model` tells it, and `version`."""


class Tape:
    """One file that is being written; what is in it can be read whenever the writing stops.

    Args:
        path: the file; there must be none.
        about: what decided.
        incident: for the file of an incident: why and when.

    Attributes:
        count: how many exchanges have been written.

    Raises:
        OSError: if it cannot be written; it is closed then. So do the methods.
    """

    def __init__(self, path: Path, about: About, incident: Mapping[str, str] | None = None) -> None:
        self.path = path
        self._stream = path.open("xb")
        _lock(self._stream)
        # A chunk ends where `flush` says, never between an exchange's messages.
        self._writer = Writer(self._stream, chunk_size=1 << 62, compression=CompressionType.ZSTD)
        self._pending = self._chunks = self._added = self.count = 0
        self._flushed = time.monotonic()
        try:
            self._writer.start(library=f"lagnet {about['version']}")
            self._writer.add_metadata(ABOUT, {name: str(value) for name, value in about["text"].items()})
            if incident is not None:
                self._writer.add_metadata(INCIDENT, dict(incident))
            made = schemas(about["layout"])
            self._channels = {topic: self._channel(topic, encoded(made[topic])) for topic in TOPICS}
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """What the file comes to if it is closed now, at most [bytes]."""
        return self._stream.tell() + self._pending + _ENDS + (self._chunks + 2) * _INDEX

    def add(self, exchange: Exchange, entries: Entries) -> None:
        """Adds an exchange."""
        number = exchange.number & 0xFFFFFFFF
        for topic, data in entries:
            channel = self._channels[topic]
            self._writer.add_message(channel, exchange.received, data, exchange.sent, number)
            self._pending += len(data) + 64
        self._added += 1
        if self._pending >= _CHUNK:
            self.flush()

    def flush(self) -> None:
        """Hands what has been added to the system: from now on it outlives this process."""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError:
            self.abandon()
            raise
        self._chunks += self._pending > 0
        self._pending, self.count = 0, self._added
        self._flushed = time.monotonic()

    def flush_if_due(self) -> None:
        """Flushes if something has waited for long enough."""
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            if self._pending:
                self.flush()
            self._flushed = time.monotonic()

    def close(self, lasting: bool = False) -> None:
        """Ends the file.

        Args:
            lasting: whether to wait until the disk has it.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            self.count = self._added
            if lasting:
                os.fsync(self._stream.fileno())
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Leaves the file as it is."""
        with suppress(OSError):  # what could not be written is tried once more
            self._stream.close()

    def _channel(self, topic: str, schema: bytes) -> int:
        name = f"lagnet.{topic.strip('/').title()}"
        return self._writer.register_channel(
            topic, "json", self._writer.register_schema(name, "jsonschema", schema)
        )


class Folder:
    """The files of one kind in a folder; where they come to too much, the oldest go.

    Args:
        path: the folder; it is made if there is none.
        kind: how their names begin.
        most: their size [bytes], all together.

    Raises:
        OSError: if it cannot be made.
    """

    def __init__(self, path: Path, kind: str, most: int) -> None:
        path.mkdir(parents=True, exist_ok=True)
        self._path, self._kind, self._most = path, kind, most

    def new(self, size: int) -> Path:
        """The name of a new file, for which there is room.

        Args:
            size: how large it may become [bytes].
        """
        # The names are in the order of time.
        files = [(file, _length(file)) for file in sorted(self._path.glob(f"{self._kind}-*.mcap"))]
        total = sum(length for _, length in files)
        for file, length in files:
            if total + size <= self._most:
                break
            total -= length * _delete(file)
        now = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        return self._path / f"{self._kind}-{now}-{os.getpid()}.mcap"


class Recording:
    """Everything, file after file.

    Args:
        folder: where to.
        about: what decided.
        file_bytes: how large a file may become.
    """

    def __init__(self, folder: Folder, about: About, file_bytes: int) -> None:
        self._folder, self._about, self._file_bytes = folder, about, file_bytes
        self._tape: Tape | None = None
        self._count = 0

    @property
    def count(self) -> int:
        """How many exchanges have been written."""
        return self._count + (0 if self._tape is None else self._tape.count)

    def add(self, exchange: Exchange, entries: Entries) -> None:
        """Records an exchange.

        Raises:
            OSError: if it cannot be written. So do the other methods.
        """
        size = sum(len(data) + 64 for _, data in entries)
        if self._tape is not None and self._tape.size + size > self._file_bytes:
            self._tape.flush()  # what is compressed is less
            if self._tape.size + size > self._file_bytes:
                self.close()
        if self._tape is None:
            self._tape = Tape(self._folder.new(max(self._file_bytes, size)), self._about)
        self._tape.add(exchange, entries)

    def flush_if_due(self) -> None:
        """Writes what has waited for long enough."""
        if self._tape is not None:
            self._tape.flush_if_due()

    def change(self, about: About) -> None:
        """Another one decides: the next file says so."""
        self.close()
        self._about = about

    def close(self) -> None:
        """Ends the file."""
        if self._tape is not None:
            try:
                self._tape.close()
            finally:
                self._count += self._tape.count
                self._tape = None


def _length(file: Path) -> int:
    """A file's size; 0 where another service has just deleted it."""
    try:
        return file.stat().st_size
    except FileNotFoundError:
        return 0


def _delete(file: Path) -> bool:
    """Deletes a file, unless another service is writing it."""
    try:
        with file.open("rb") as stream:
            if not _lock(stream):
                return False
            file.unlink()
    except PermissionError:  # on Windows: it is open elsewhere
        return False
    except FileNotFoundError:
        return True
    return True


def _lock(stream: IO[bytes]) -> bool:
    """Says that a file is in use, where the system knows how; False if it already is."""
    if os.name == "nt":
        return True
    import fcntl

    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
