"""What goes through the pipe between the service and the recorder's process.

A frame is eight bytes that say how long it is, and that many of `marshal`: it is the pipe of one program, and
both its ends run the same interpreter.
"""

from __future__ import annotations

import marshal
from collections.abc import Iterator
from typing import IO, Any


def frame(value: Any) -> bytes:
    """A value as a frame: numbers, texts, bytes, None, and tuples, lists and dicts of them."""
    body = marshal.dumps(value)
    return len(body).to_bytes(8, "little") + body


def frames(stream: IO[bytes]) -> Iterator[Any]:
    """What has been sent, frame by frame, up to the end or to a frame that is not whole."""
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head, "little")
        if len(body := stream.read(length)) < length:
            return
        yield marshal.loads(body)
