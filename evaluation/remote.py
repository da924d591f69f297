"""Robots that ask a running service."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from decision import BatchDecider
from evaluation.errors import ServiceError
from evaluation.watched import Watched
from server import ClientError, Fleet, ModelReply
from server.serve import ServeError, read_api_key


@contextmanager
def asked(
    url: str, layout: Sequence[dict[str, Any]], timeout: float, key_file: Path | None = None
) -> Iterator[tuple[BatchDecider, ModelReply]]:
    """What decides through a service, and what the service says about itself.

    Args:
        url: the service.
        layout: the robots' observation layout; compared with the service's.
        timeout: how long a robot waits for its action [s].
        key_file: holds the service's key; None: the environment may.

    Raises:
        ServiceError: if the service cannot be used.
        ServiceGoneError: within, as soon as it has stopped answering.
    """
    try:
        key = read_api_key(key_file)
    except ServeError as error:
        raise ServiceError(str(error)) from error

    def connect() -> Fleet:
        try:
            # Late replies are in the figures, however many there are in a row.
            return Fleet(url, layout, timeout, key, most_failures=None)
        except ClientError as error:
            raise ServiceError(str(error)) from error

    with connect() as fleet:
        try:
            yield Watched(fleet, lambda: connect().close()), fleet.model()
        except ClientError as error:  # further robots are connected as they are needed
            raise ServiceError(str(error)) from error
