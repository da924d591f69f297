"""What the service does not wait for, does not believe, and does not take on."""

from __future__ import annotations

from dataclasses import dataclass, field

from server.freshness import Limits


@dataclass(frozen=True)
class Safety:
    """The limits within which a service decides.

    Attributes:
        deadline: how long a decision may take [s]; None: as long as it likes.
        freshness: how old what a robot sees may be.
        max_in_flight: most requests of one client address that await their decisions.
        max_in_flight_all: most of all clients together.
    """

    deadline: float | None = None
    freshness: Limits = field(default_factory=Limits)
    max_in_flight: int = 64
    max_in_flight_all: int = 256
