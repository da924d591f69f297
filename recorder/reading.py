"""Reads recordings, also those that nobody ended and those that are damaged in places."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Self

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from pydantic_core import from_json

from recorder.channels import DECISION, REPLY, REQUEST, TOPICS
from recorder.errors import RecordingError
from recorder.tape import ABOUT, INCIDENT

_BROKEN = (McapError, struct.error, ValueError, EOFError, KeyError, zstandard.ZstdError)
"""What the library raises on bytes that are none of a recording's."""
_MOST_BYTES = 1 << 30
"""No record is larger."""


class Recorded(NamedTuple):
    """An exchange as it was recorded."""

    number: int
    """The service counted them."""
    received: int
    """When the request had come [ns since 1970]."""
    sent: int
    """When the reply was made [ns since 1970]."""
    request: bytes
    """The request's body."""
    reply: bytes
    """The reply's body."""
    decisions: list[dict[str, Any]]
    """What `/decision` says of each robot."""


class Reader:
    """Reads one file from its beginning, once.

    Args:
        path: the file.

    Attributes:
        model: what decided, as `GET /model` told it.
        filter_config: the settings of its filter.
        incident: why and when there was an incident; None in other files.
        ended: whether the file's end was found; without, its writer was killed or the disk full.
        damaged: how many stretches of the file could not be read; a stretch is half a second or a megabyte.
        missing: how many exchanges between its first and its last are not in it.

    Raises:
        RecordingError: if it is no recording of this service.
        OSError: if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream = path.open("rb")
        self.incident: dict[str, str] | None = None
        self.ended, self.damaged, self.missing = False, 0, 0
        # As the writer counts them: what it says of them is in the first stretch, which may be damaged.
        self._topics = dict(enumerate(TOPICS, 1))
        self._records = self._read()
        self._ahead: list[McapRecord] = []
        try:
            self.model, self.filter_config = self._about()
        except BaseException:
            self.close()
            raise

    def exchanges(self) -> Iterator[Recorded]:
        """The exchanges, in the order in which they were recorded."""
        last: int | None = None
        for number, messages in self._together():
            found: dict[str, list[Message]] = {}
            for message in messages:
                found.setdefault(self._topics.get(message.channel_id, ""), []).append(message)
            if REQUEST not in found or REPLY not in found:
                continue
            request, reply = found[REQUEST][0], found[REPLY][0]
            decisions = [from_json(message.data) for message in found.get(DECISION, [])]
            if last is not None and number > last + 1:
                self.missing += number - last - 1
            last = number
            yield Recorded(
                number, request.log_time, request.publish_time, request.data, reply.data, decisions
            )

    def close(self) -> None:
        """Closes the file."""
        self._stream.close()

    def __enter__(self) -> Self:
        """The reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the file."""
        self.close()

    def _about(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reads on to the first message; what the metadata before it tell of."""
        about: tuple[dict[str, Any], dict[str, Any]] | None = None
        for record in self._records:
            if isinstance(record, Metadata) and record.name == ABOUT:
                about = json.loads(record.metadata["model"]), json.loads(record.metadata["filter"])
            elif isinstance(record, Metadata) and record.name == INCIDENT:
                self.incident = record.metadata
            elif isinstance(record, Channel | Message):
                self._ahead = [record]
                break
        if about is None:
            raise RecordingError(f"{self._path}: no recording of lagnet-serve")
        return about

    def _together(self) -> Iterator[tuple[int, list[Message]]]:
        """The messages of each exchange: they stand together."""
        number, messages = -1, list[Message]()
        for record in chain(self._ahead, self._records):
            if isinstance(record, Channel):
                self._topics[record.id] = record.topic
            if not isinstance(record, Message):
                continue
            if record.sequence != number and messages:
                yield number, messages
                messages = []
            number = record.sequence
            messages.append(record)
        if messages:
            yield number, messages

    def _read(self) -> Iterator[McapRecord]:
        """The file's records, with those in its chunks, up to its end or to where it breaks off."""
        records = StreamReader(self._stream, emit_chunks=True, record_size_limit=_MOST_BYTES).records
        while True:
            try:
                record = next(records)
            except StopIteration:
                self.ended = True
                return
            except _BROKEN:
                return
            if not isinstance(record, Chunk):
                yield record
                continue
            try:
                inside = breakup_chunk(record, validate_crc=True)
            except _BROKEN:
                self.damaged += 1
                continue
            yield from inside
