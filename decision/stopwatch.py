"""How long the parts of a decision take."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import perf_counter
from typing import ParamSpec, TypeVar

_KEPT = 4096
"""So many laps wait for whoever reads them; of more, the oldest go."""

Given = ParamSpec("Given")
Result = TypeVar("Result")


class Stopwatch:
    """Calls functions, and keeps for how long each ran; from any thread.

    Attributes:
        laps: name and duration [s], in order; whoever reads them takes them out.
    """

    def __init__(self) -> None:
        self.laps: deque[tuple[str, float]] = deque(maxlen=_KEPT)

    def __call__(
        self, name: str, function: Callable[Given, Result], *given: Given.args, **named: Given.kwargs
    ) -> Result:
        """What a function returns; what it raises is raised, and no lap is kept."""
        began = perf_counter()
        result = function(*given, **named)
        self.laps.append((name, perf_counter() - began))
        return result
