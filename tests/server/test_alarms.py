"""Alarms: delays, deadband, latch, chatter, beside an independent account of what they have to be."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.alarms import (
    CHATTER_SECONDS,
    RULES,
    Alarm,
    Alarms,
    AlarmsError,
    Rule,
    Standing,
    read_rules,
    table,
)

STEP = 0.25

RULE = st.builds(
    Rule,
    limit=st.just(1.0),
    deadband=st.sampled_from([0.0, 0.5]),
    on_delay=st.sampled_from([0.0, 0.5, 1.0]),
    off_delay=st.sampled_from([0.0, 0.5, 1.0]),
    latch=st.booleans(),
)
VALUES = st.lists(st.sampled_from([0.0, 0.6, 1.0, 1.2, 2.0]), min_size=1, max_size=60)


def run(rule: Rule, values: list[float]) -> list[Standing]:
    alarm = Alarm(rule, 0.0)
    seen = []
    for k, value in enumerate(values):
        alarm.look(value, k * STEP, "a test")
        seen.append(alarm.standing)
    return seen


def lasting(holds: list[bool], k: int, delay: float) -> bool:
    """Whether something holds at a look and did at all looks within the delay before it."""
    n = round(delay / STEP)
    return k >= n and all(holds[k - n : k + 1])


@given(RULE, VALUES)
def test_it_is_set_and_cleared_as_the_delays_say(rule: Rule, values: list[float]) -> None:
    seen = run(rule, values)
    on = [value > rule.limit for value in values]
    off = [value <= rule.limit - rule.deadband for value in values]
    before = Standing.CLEAR
    began = 0  # where it was last set or cleared: no delay reaches back beyond
    for k, standing in enumerate(seen):
        if before is Standing.ACTIVE:
            ends = lasting(off[began:], k - began, rule.off_delay)
            rest = Standing.LATCHED if rule.latch else Standing.CLEAR
            assert standing is (rest if ends else Standing.ACTIVE)
        else:
            begins = lasting(on[began:], k - began, rule.on_delay)
            waiting = Standing.LATCHED if before is Standing.LATCHED else Standing.CLEAR
            if on[k] and waiting is Standing.CLEAR:
                waiting = Standing.PENDING
            assert standing is (Standing.ACTIVE if begins else waiting)
        if (standing is Standing.ACTIVE) != (before is Standing.ACTIVE):
            began = k + 1
        before = standing


@given(RULE, VALUES, st.data())
def test_what_is_not_known_changes_nothing(rule: Rule, values: list[float], data) -> None:
    """Neither does it set an alarm, nor does it ever clear one."""
    alarm = Alarm(rule, 0.0)
    for k, value in enumerate(values):
        alarm.look(value, k * STEP, "a test")
        before = alarm.standing, alarm.since, alarm.cause
        alarm.look(data.draw(st.sampled_from([None, math.nan])), k * STEP, "nothing known")
        assert (alarm.standing, alarm.since, alarm.cause) == before


def test_a_latched_one_waits_for_somebody_to_see_it() -> None:
    alarm = Alarm(Rule(limit=0.0, off_delay=0.0, latch=True), 0.0)
    alarm.look(1.0, 1.0, "the disk is full")
    assert (alarm.standing, alarm.since, alarm.cause) == (Standing.ACTIVE, 1.0, "the disk is full")
    alarm.look(0.0, 2.0, "")
    assert (alarm.standing, alarm.cause) == (Standing.LATCHED, "the disk is full")
    alarm.look(0.0, 1e6, "")
    assert alarm.standing is Standing.LATCHED
    alarm.acknowledge(1e6)
    assert (alarm.standing, alarm.cause, alarm.acknowledged) == (Standing.CLEAR, "", False)
    # Seen while it lasts, it clears by itself; seen once is not seen for ever.
    alarm.look(1.0, 1e6, "again")
    alarm.acknowledge(1e6)
    assert (alarm.standing, alarm.acknowledged) == (Standing.ACTIVE, True)
    alarm.look(0.0, 1e6 + 1, "")
    assert alarm.standing is Standing.CLEAR
    alarm.look(1.0, 1e6 + 2, "a third time")
    assert not alarm.acknowledged


@given(st.lists(st.floats(0.5, 60.0), min_size=6, max_size=20))
def test_three_cycles_a_minute_are_chatter(gaps: list[float]) -> None:
    alarm = Alarm(Rule(limit=0.0, off_delay=0.0), 0.0)
    now, cleared = 0.0, []
    for gap in gaps:
        alarm.look(1.0, now, "a test")
        now += gap
        alarm.look(0.0, now, "")
        cleared.append(now)
        chatter = sum(now - at <= CHATTER_SECONDS for at in cleared) >= 3
        assert alarm.chatters(now) is chatter
    assert not alarm.chatters(now + CHATTER_SECONDS + 1.0)


def test_they_count_for_whom_they_were_raised() -> None:
    told: list[tuple[str, Standing]] = []
    alarms = Alarms(RULES, 0.0, lambda name, alarm: told.append((name, alarm.standing)))
    for k in range(500):
        alarms.raise_("staleness", f"robot{k % 400}")
    alarms.look({name: (0.0, "") for name in RULES if name != "staleness"}, 1.0)
    alarm = alarms.alarms["staleness"]
    assert alarm.standing is Standing.ACTIVE
    assert "robot0, robot1, robot2 and" in alarm.cause
    for k in range(400):
        alarms.lower("staleness", f"robot{k}")
    for now in (2.0, 8.0):
        alarms.look({name: (0.0, "") for name in RULES if name != "staleness"}, now)
    assert alarm.standing is Standing.LATCHED
    alarms.acknowledge("staleness", 9.0)
    assert told == [("staleness", one) for one in (Standing.ACTIVE, Standing.LATCHED, Standing.CLEAR)]
    (listed,) = (one for one in alarms.to_json(9.0, 1000.0) if one["name"] == "staleness")
    assert (listed["since"], listed["state"], listed["cause"]) == (1000.0, "clear", None)
    with pytest.raises(KeyError):
        alarms.acknowledge("nothing", 9.0)


def test_a_file_changes_settings(tmp_path: Path) -> None:
    path = tmp_path / "alarms.toml"
    path.write_text('[risk]\nlimit = 1\n[latency]\non_delay = 0.5\neffect = "degrade"\n')
    rules = read_rules(path)
    assert (rules["risk"].limit, rules["risk"].on_delay) == (1.0, RULES["risk"].on_delay)
    assert (rules["latency"].effect, rules["novelty"]) == ("degrade", RULES["novelty"])
    assert read_rules(None) == RULES


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[speed]\nlimit = 1", "speed: expected a table"),
        ("risk = 1", "risk: expected a table"),
        ("[risk]\nlimits = 1", "risk.limits"),
        ('[risk]\nlimit = "1"', "risk.limit"),
        ("[risk]\nlimit = nan", "risk.limit"),
        ("[risk]\non_delay = -1", "risk.on_delay"),
        ("[risk]\nlatch = 1", "risk.latch"),
        ('[risk]\neffect = "stop"', "risk.effect"),
        ('[risk]\nabout = "x"', "risk.about"),
        ("[risk]\ndeadband = 2", "risk.deadband"),
        ("[risk", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_what_is_wrong(tmp_path: Path, text, named) -> None:
    path = tmp_path / "alarms.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(AlarmsError, match=named) as error:
        read_rules(path)
    assert str(path) in str(error.value)


def test_the_documentation_has_the_settings() -> None:
    assert table() in (Path(__file__).parents[2] / "docs" / "service.md").read_text()
