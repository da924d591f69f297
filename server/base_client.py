"""What every client is, however its bytes travel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from decision import Faults
from server.address import Address, addresses
from server.schema import ModelReply
from server.session import MOST_FAILURES, Session

DEFAULT_TIMEOUT = 0.02
"""How long a robot waits for its action [s]: one control step, for which a certified action may last."""
CONNECT_TIMEOUT = 5.0
"""How long connecting may take before the robot moves [s]."""


class BaseClient:
    """Arguments and attributes as `server.Client` documents them."""

    def __init__(
        self,
        url: str | Sequence[str],
        observation_layout: Sequence[Mapping[str, Any]] | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        api_key: str | None = None,
        robot: str | None = None,
        most_failures: int | None = MOST_FAILURES,
        raises: bool = False,
        clock: Callable[[], float] | None = None,
        ca_file: str | Path | None = None,
    ) -> None:
        if not (math.isfinite(timeout) and timeout > 0.0):
            raise ValueError(f"timeout must be finite and positive, got {timeout}")
        self._session = Session(observation_layout, robot, most_failures, raises, clock)
        self._timeout = timeout
        self._begin(addresses(url, api_key, ca_file))

    @property
    def faults(self) -> Faults:
        """What went wrong so far."""
        return self._session.faults

    @faults.setter
    def faults(self, shared: Faults) -> None:
        self._session.faults = shared

    @property
    def held(self) -> str | None:
        """Why it holds until `resume`, or None."""
        return self._session.held

    def model(self) -> ModelReply:
        """What the service said about itself at connect."""
        return self._session.model

    def _begin(self, found: Sequence[Address]) -> None:
        """Makes a link to each service."""
        raise NotImplementedError
