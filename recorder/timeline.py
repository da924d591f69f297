"""A recording as a timeline: what became of each robot, step by step."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rich import box
from rich.table import Table

_NUMBER = re.compile(r"-?\d[\d.e+-]*")
_EXCERPT = 120
FAULT = "fault"
"""In the place of the mode of a decision that could not be told."""


@dataclass(frozen=True)
class Row:
    """One decision about one robot.

    Attributes:
        at: when it was asked for [ns since 1970].
        robot: its number in the recording.
        mode: what became of the nominal action; `FAULT` where there was no decision.
        origin: where another action came from.
        opened_by: why the filter was active.
        risk: λ; NaN where it is not known. So are the others.
        threshold: the gate's.
        barrier: [m].
        action: thrust and turn, as sent.
        nominal: thrust and turn, the policy's.
        reason: of a fallback.
    """

    at: int
    robot: int
    mode: str
    origin: str
    opened_by: str
    risk: float
    threshold: float
    barrier: float
    action: tuple[float, float]
    nominal: tuple[float, float]
    reason: str

    @staticmethod
    def of(at: int, decision: Mapping[str, Any]) -> Row:
        """What `/decision` tells."""

        def text(name: str) -> str:
            return str(decision.get(name, ""))

        def number(name: str) -> float:
            return float(decision.get(name, math.nan))

        def pair(name: str) -> tuple[float, float]:
            first, second = decision.get(name, (math.nan, math.nan))
            return float(first), float(second)

        return Row(
            at=at,
            robot=int(decision["robot"]),
            mode=FAULT if "fault" in decision else text("mode"),
            origin=text("origin"),
            opened_by=text("opened_by"),
            risk=number("risk"),
            threshold=number("threshold"),
            barrier=number("barrier"),
            action=pair("action"),
            nominal=pair("nominal_action"),
            reason=text("reason"),
        )

    @property
    def kind(self) -> tuple[str, ...]:
        """What a change is a change of: not the numbers in a reason."""
        return self.mode, self.origin, self.opened_by, _NUMBER.sub("#", self.reason)


@dataclass
class Timeline:
    """The decisions of a recording.

    Attributes:
        zero: the time that is 0 [ns since 1970].
        rows: all of them, in order.
    """

    zero: int
    rows: list[Row] = field(default_factory=list)

    def seconds(self, row: Row) -> float:
        """When a decision was asked for [s]."""
        return (row.at - self.zero) / 1e9

    def robots(self) -> list[int]:
        """The robots' numbers."""
        return sorted({row.robot for row in self.rows})

    def of_most_interest(self) -> int:
        """The robot that was sent the first fallback; else the one whose actions were replaced most often."""
        for row in self.rows:
            if row.mode in ("fallback", FAULT):
                return row.robot
        replaced = dict.fromkeys(self.robots(), 0)
        for row in self.rows:
            replaced[row.robot] += row.mode != "nominal"
        return max(replaced, key=lambda robot: replaced[robot])

    def changes(self) -> Iterable[tuple[Row, int]]:
        """Where something changed for a robot, and for how many steps it then stayed so."""
        current: dict[int, int] = {}
        found: list[tuple[Row, int]] = []
        for row in self.rows:
            place = current.get(row.robot)
            if place is not None and found[place][0].kind == row.kind:
                found[place] = (found[place][0], found[place][1] + 1)
            else:
                current[row.robot] = len(found)
                found.append((row, 1))
        return found

    def table(self, every: bool = False) -> Table:
        """As a table: where something changed, or every step."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        columns = ("time [s]", "robot", "steps", "mode", "origin", "opened by", "λ", "barrier [m]", "action")
        right = {"time [s]", "robot", "steps", "λ", "barrier [m]", "action"}
        for name in columns:
            table.add_column(name, justify="right" if name in right else "left", no_wrap=True)
        table.add_column("reason", overflow="fold")
        shown = [(row, 1) for row in self.rows] if every else self.changes()
        for row, steps in shown:
            table.add_row(
                f"{self.seconds(row):.3f}",
                str(row.robot),
                str(steps),
                row.mode,
                row.origin,
                row.opened_by,
                _number(row.risk, ".3g"),
                _number(row.barrier, ".3f"),
                " ".join(_number(value, "+.3f") for value in row.action),
                row.reason if len(row.reason) <= _EXCERPT else f"{row.reason[:_EXCERPT]}…",
            )
        return table


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"
