"""Which requests a browser makes for pages that are not ours: any page may post to any address."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
"""They change nothing, and no other site's page may read their answers."""


def is_foreign(method: str, headers: Mapping[bytes, bytes]) -> bool:
    """Whether a browser asks for a change on behalf of another site's page.

    Browsers say so by `Sec-Fetch-Site`, where the connection is one that they trust, and by `Origin`. Whoever
    sends neither is no browser. The rule is that of `http.CrossOriginProtection` in Go's standard library.
    """
    if method in _SAFE:
        return False
    site = headers.get(b"sec-fetch-site")
    if site is not None:
        return site not in (b"same-origin", b"none")
    origin = headers.get(b"origin")
    return origin is not None and origin.partition(b"://")[2] != headers.get(b"host")


@lru_cache(maxsize=64)
def is_own(host: bytes) -> bool:
    """Whether no other site can have a `Host` lead here: an address, localhost, or a name without a dot.

    A page whose own name leads to this machine (DNS rebinding) could read and ask for whatever ours can.
    """
    if host.startswith(b"["):
        return True
    name = host.partition(b":")[0].lower()
    labels = name.split(b".")
    # No name's last label is a number.
    return len(labels) == 1 or labels[-1] == b"localhost" or labels[-1].isdigit()
