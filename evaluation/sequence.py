"""Fixed-sequence testing: hypotheses in an order, until one is not rejected; no correction is needed.

Angelopoulos et al., *Learn then Test*, 2021, section 2.3: where the order was fixed before, the probability
that any true hypothesis is rejected is at most δ, since it would have to be the first true one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Candidate = TypeVar("Candidate")


def last_to_pass(candidates: Sequence[Candidate], passes: Callable[[Candidate], bool]) -> Candidate | None:
    """The last candidate before the first that does not pass, or None; none is tried after that one."""
    chosen = None
    for candidate in candidates:
        if not passes(candidate):
            break
        chosen = candidate
    return chosen
