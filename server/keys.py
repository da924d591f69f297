"""Who may do what: a key to read, one to ask for decisions, one to change things."""

from __future__ import annotations

import hmac
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

ACT, BATCH, STREAM = "/act", "/act/batch", "/act/stream"
MODEL, HOLD, RESUME, ALARMS = "/model", "/hold", "/resume", "/alarms"
HOME, PAGE = "/", "/page/"
"""The live page, and what its files' paths begin with: they hold no secret."""
HEALTH = frozenset({"/healthz", "/readyz"})
"""What an orchestrator asks."""


class Level(IntEnum):
    """What somebody may do; each includes those before it."""

    NOTHING = 0
    """Ask whether the service is alive and ready; load the live page, which then asks for a key."""
    READ = 1
    """Look at it: whatever is a GET."""
    ACT = 2
    """Ask for decisions, and acknowledge alarms."""
    ADMIN = 3
    """Change it: whatever else is no GET."""


def needed(scope: Mapping[str, Any]) -> Level:
    """What a request takes, by its ASGI scope."""
    path = scope["path"]
    if path == ACT or path.startswith(f"{ACT}/"):
        return Level.ACT
    if path.startswith(f"{ALARMS}/"):
        return Level.ACT  # whoever drives robots says that an alarm was seen
    if path in HEALTH or path == HOME or path.startswith(PAGE):
        return Level.NOTHING
    return Level.READ if scope.get("method", "GET") in ("GET", "HEAD") else Level.ADMIN


@dataclass(frozen=True)
class Keys:
    """The keys of a service. Without any, everybody may read and ask for decisions.

    Attributes:
        read: for `Level.READ`; None: there is none, and only the higher ones read.
        act: for `Level.ACT` as well.
        admin: for everything. Without it nobody may change anything.

    Raises:
        ValueError: if two are the same, or there is a key to read and none to act.
    """

    read: str | None = None
    act: str | None = None
    admin: str | None = None

    def __post_init__(self) -> None:
        given = [key for key in (self.read, self.act, self.admin) if key is not None]
        if len(set(given)) < len(given):
            raise ValueError("the read, act and admin keys must differ")
        if self.read is not None and self.act is None and self.admin is None:
            raise ValueError("beside a read key there must be an act or an admin key: nobody could ask")

    @cached_property
    def _levels(self) -> list[tuple[bytes, Level]]:
        keys = ((self.read, Level.READ), (self.act, Level.ACT), (self.admin, Level.ADMIN))
        return [(key.encode(), level) for key, level in keys if key is not None]

    @property
    def any(self) -> bool:
        """Whether there is a key at all."""
        return bool(self._levels)

    def granted(self, headers: Mapping[bytes, bytes]) -> Level:
        """What whoever sends these headers may do; every key is compared, in constant time."""
        if not self._levels:
            return Level.ACT
        scheme, _, bearer = headers.get(b"authorization", b"").partition(b" ")
        given = bearer.strip() if scheme.lower() == b"bearer" else headers.get(b"x-api-key", b"")
        granted = Level.NOTHING
        for key, level in self._levels:
            if hmac.compare_digest(given, key):
                granted = level
        return granted
