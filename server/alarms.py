"""Alarms: what an operator is told, once it has lasted, until it has been over for long enough.

Each has an on-delay, an off-delay, a deadband and, where what has happened must be looked at, a latch, as
process control has them (ISA-18.2, IEC 62682). Time comes in as an argument.
"""

from __future__ import annotations

import math
import tomllib
from collections import deque
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

CHATTER, CHATTER_SECONDS = 3, 60.0
"""An alarm chatters if it was set and cleared so many times within so long [s]."""
_MOST_RAISED = 256
"""So many who raise one alarm are told apart; it is raised all the same."""

Seconds = Annotated[float, Field(strict=True, ge=0.0, le=3600.0, allow_inf_nan=False)]
Amount = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)]
Effect = Literal["tell", "degrade", "hold"]


class Rule(BaseModel):
    """When an alarm is set and cleared.

    Attributes:
        limit: it is set above this.
        deadband: it clears at most at `limit - deadband`.
        on_delay: for how long the value has to be above the limit before it is set [s].
        off_delay: for how long it has to be low before it clears [s].
        latch: whether it stays, once it would clear, until it has been acknowledged.
        effect: tell; degrade: the service is degraded while it is active; hold: the service is held.
        about: what its value is.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    limit: Amount
    deadband: Amount = 0.0
    on_delay: Seconds = 0.0
    off_delay: Seconds = 5.0
    latch: Annotated[bool, Field(strict=True)] = False
    effect: Effect = "tell"
    about: str = ""


RULES: dict[str, Rule] = {
    "risk": Rule(
        limit=0.8,
        deadband=0.1,
        on_delay=5.0,
        about="share of the last 10 s' decisions with a risk score above the threshold",
    ),
    "fallbacks": Rule(
        limit=0.01, deadband=0.005, latch=True, about="share of fallbacks in them; a hold's are not counted"
    ),
    "novelty": Rule(limit=0.05, deadband=0.02, on_delay=1.0, about="share of novelties above 1 in them"),
    "latency": Rule(
        limit=0.02, on_delay=2.0, about="99th percentile of the last 10 s' requests, as a bucket's bound [s]"
    ),
    "staleness": Rule(limit=0.0, latch=True, about="how many robots send nothing, or what is too old"),
    "faults": Rule(
        limit=4.0, off_delay=0.0, effect="degrade", about="internal faults within the last minute"
    ),
    "recorder": Rule(limit=0.0, latch=True, about="1 once a recording has stopped"),
}
"""The alarms there are, with the settings that they have unless a file says otherwise."""


class AlarmsError(ValueError):
    """Settings of alarms that cannot be used."""


class Standing(StrEnum):
    """How an alarm stands."""

    CLEAR = "clear"
    PENDING = "pending"
    """The value is above the limit, not for long enough yet."""
    ACTIVE = "active"
    LATCHED = "latched"
    """It is over, and waits to be acknowledged."""


class Alarm:
    """One alarm.

    Args:
        rule: its settings.
        now: the time [s].

    Attributes:
        standing: how it stands.
        since: since when [s].
        value: the last one; None: not known.
        cause: what set it, in words; empty while it is clear.
        acknowledged: whether somebody has seen it since it was set.
    """

    def __init__(self, rule: Rule, now: float) -> None:
        self.rule = rule
        self.standing = Standing.CLEAR
        self.since = now
        self.value: float | None = None
        self.cause = ""
        self.acknowledged = False
        self._high_since: float | None = None
        self._low_since: float | None = None
        self._cycles: deque[float] = deque(maxlen=CHATTER)

    def chatters(self, now: float) -> bool:
        """Whether it is set and cleared again and again."""
        return len(self._cycles) == CHATTER and now - self._cycles[0] <= CHATTER_SECONDS

    def look(self, value: float | None, now: float, cause: str) -> None:
        """Takes the newest value; one that is not known (None, NaN) changes nothing: it proves nothing.

        Args:
            value: what is compared with the limit.
            now: the time [s], never before that of the last look.
            cause: why the value is what it is, in words.
        """
        self.value = value
        rule = self.rule
        if value is None or math.isnan(value):
            return
        if self.standing is Standing.ACTIVE:
            self._while_active(value > rule.limit - rule.deadband, now)
        elif value <= rule.limit:
            self._high_since = None
            if self.standing is Standing.PENDING:
                self._pass(Standing.CLEAR, now)
        else:
            self._high_since = now if self._high_since is None else self._high_since
            if now - self._high_since >= rule.on_delay:
                self._pass(Standing.ACTIVE, now, cause)
            elif self.standing is Standing.CLEAR:
                self._pass(Standing.PENDING, now, cause)

    def acknowledge(self, now: float) -> None:
        """Somebody has seen it: a latched one clears."""
        if self.standing in (Standing.ACTIVE, Standing.LATCHED):
            self.acknowledged = True
        if self.standing is Standing.LATCHED:
            self._pass(Standing.CLEAR, now)

    def _while_active(self, high: bool, now: float) -> None:
        if high:
            self._low_since = None
            return
        self._low_since = now if self._low_since is None else self._low_since
        if now - self._low_since >= self.rule.off_delay:
            self._cycles.append(now)
            latched = self.rule.latch and not self.acknowledged
            self._pass(Standing.LATCHED if latched else Standing.CLEAR, now)

    def _pass(self, standing: Standing, now: float, cause: str | None = None) -> None:
        self.standing, self.since = standing, now
        self._low_since = None
        if standing is Standing.ACTIVE:
            self._high_since, self.acknowledged = None, False
        if standing is Standing.CLEAR:
            self.cause, self.acknowledged = "", False
        elif cause is not None:
            self.cause = cause


Value = tuple[float | None, str]
"""What is compared with an alarm's limit, and why it is what it is, in words."""


class Alarms:
    """All alarms of one service.

    Args:
        rules: name → settings.
        now: the time [s].
        told: called with the name and the alarm when one is set, latches, or clears after that.

    Attributes:
        alarms: name → alarm.
    """

    def __init__(
        self, rules: Mapping[str, Rule], now: float, told: Callable[[str, Alarm], None] | None = None
    ) -> None:
        self.alarms = {name: Alarm(rule, now) for name, rule in rules.items()}
        self._told = told
        self._raised: dict[str, dict[str, None]] = {name: {} for name in rules}

    def raise_(self, name: str, who: str) -> None:
        """Counts one more for whom an alarm is to be set; from any thread, again and again.

        Args:
            name: the alarm's; its value is how many there are.
            who: a robot's name, for example.
        """
        raised = self._raised[name]
        if len(raised) < _MOST_RAISED:
            raised[who] = None

    def lower(self, name: str, who: str) -> None:
        """All is well again with whom `raise_` named."""
        self._raised[name].pop(who, None)

    def look(self, values: Mapping[str, Value], now: float) -> None:
        """Looks at all alarms.

        Args:
            values: of alarms by name; those that are not here count who was raised.
            now: the time [s].
        """
        for name, alarm in self.alarms.items():
            before = alarm.standing
            value, cause = values.get(name) or self._count(name)
            alarm.look(value, now, cause)
            self._tell(name, before)

    def acknowledge(self, name: str, now: float) -> None:
        """Somebody has seen an alarm.

        Raises:
            KeyError: if there is none of that name.
        """
        before = self.alarms[name].standing
        self.alarms[name].acknowledge(now)
        self._tell(name, before)

    def active(self, effect: Effect) -> list[str]:
        """The names of the active alarms that have an effect."""
        return [
            name
            for name, alarm in self.alarms.items()
            if alarm.standing is Standing.ACTIVE and alarm.rule.effect == effect
        ]

    def to_json(self, now: float, wall: float) -> list[dict[str, Any]]:
        """All alarms as plain JSON, with times since 1970.

        Args:
            now: the time on the clock of `look` [s].
            wall: the time since 1970 [s].
        """
        return [
            {
                "name": name,
                "state": str(alarm.standing),
                "since": round(wall - (now - alarm.since), 3),
                "value": alarm.value if alarm.value is None or math.isfinite(alarm.value) else None,
                "limit": alarm.rule.limit,
                "acknowledged": alarm.acknowledged,
                "cause": alarm.cause or None,
                "chattering": alarm.chatters(now),
                "effect": alarm.rule.effect,
                "about": alarm.rule.about,
            }
            for name, alarm in self.alarms.items()
        ]

    def _count(self, name: str) -> Value:
        raised = list(self._raised[name])
        more = f" and {len(raised) - 3} more" if len(raised) > 3 else ""
        return float(len(raised)), ", ".join(raised[:3]) + more

    def _tell(self, name: str, before: Standing) -> None:
        after = self.alarms[name].standing
        quiet = {before, after} <= {Standing.CLEAR, Standing.PENDING}
        if self._told is not None and before is not after and not quiet:
            self._told(name, self.alarms[name])


def read_rules(path: Path | None) -> dict[str, Rule]:
    """The alarms' settings: those of `RULES`, with what a TOML file has otherwise, a table an alarm.

    Raises:
        AlarmsError: naming the file, the alarm and the setting that cannot be used.
    """
    if path is None:
        return dict(RULES)
    try:
        told = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise AlarmsError(f"{path}: cannot be read: {error}") from error
    rules = dict(RULES)
    for name, changes in told.items():
        if name not in RULES or not isinstance(changes, dict):
            raise AlarmsError(f"{path}: {name}: expected a table [NAME], NAME one of {', '.join(RULES)}")
        if "about" in changes:
            raise AlarmsError(f"{path}: {name}.about: says what the alarm is about, and cannot be set")
        try:
            rules[name] = Rule.model_validate(RULES[name].model_dump() | changes)
        except ValidationError as error:
            item = error.errors()[0]
            where = ".".join(map(str, (name, *item["loc"])))
            raise AlarmsError(f"{path}: {where}: {item['msg']}") from error
        if rules[name].deadband > rules[name].limit:
            raise AlarmsError(f"{path}: {name}.deadband must not exceed the limit: it could never clear")
    return rules


def table() -> str:
    """The settings in Markdown, as the documentation has them."""
    rows = [
        f"| {name} | {rule.about} | {rule.limit:g} | {rule.deadband:g} | {rule.on_delay:g} | "
        f"{rule.off_delay:g} | {'yes' if rule.latch else 'no'} | {rule.effect} |"
        for name, rule in RULES.items()
    ]
    head = "| alarm | its value | limit | deadband | on-delay [s] | off-delay [s] | latch | effect |"
    return "\n".join([head, "|---|---|---|---|---|---|---|---|", *rows])
