"""Who is led, and by which reference."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter import FilterConfig, Step
from filter.circulation import SIDE_STEPS
from filter.config import settings
from guide.path import Path, drives_round, shortest_path, steer
from system.compiled import SOURCES, compiled, entry
from system.lidar import decode_goal, likeliest, unexplained
from system.point_robot import ROBOT, State, stopping

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Records = NDArray[np.void]

Strength = Literal["off", "refusal", "ahead"]
"""How much a guide may do. off: nothing. refusal: lead a robot whose nominal action has no certificate, until
it is past what is in its way. ahead: lead every robot that has something in its way and does not drive round
it by itself: a planner drives then, and most of the actions that it replaces have a certificate."""
STRENGTHS: tuple[Strength, ...] = get_args(Strength)
DEFAULT_STRENGTH: Strength = "refusal"


@dataclass(frozen=True)
class GuideConfig:
    """Settings of the guide.

    Raises:
        ValueError: if a value is out of its range.
    """

    lookahead: float = 1.2
    """A hazard nearer than this on the straight way to the goal is driven round [m]."""
    clearance: float = 0.06
    """Distance that the way round keeps from what the certificate asks for [m]."""
    pursuit: float = 0.65
    """How far ahead of the robot, along the way round, the stop point is steered to [m]."""
    eagerness: float = 1.5
    """Thrust on the way round, per cosine of the heading's error."""
    repulsion: float = 4.0
    """How strongly the way round leads away from a hazard that is nearer than ``clearance``."""
    steadiness: float = 0.5
    """Length by which the other way round must be shorter before the robot changes its mind [m]."""
    hold: float = 100
    engage: float = 0.1
    slow: float = 0.1
    """A robot whose stop point is nearer than this [m] and whose nominal action is refused is led on."""

    def __post_init__(self) -> None:
        """Refuse settings that lead nowhere."""
        for name in ("lookahead", "clearance", "pursuit", "eagerness"):
            if not 0.0 < getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in (0, 100), got {getattr(self, name)!r}")
        for name in ("repulsion", "steadiness", "slow"):
            if not 0.0 <= getattr(self, name) < 200.0:
                raise ValueError(f"{name} must be in [0, 100), got {getattr(self, name)!r}")


_OWN = tuple(GuideConfig.__dataclass_fields__)
_OF_FILTER = ("margin", "position_error", "bearing_error", "hazard_radius")
GUIDE = np.dtype([("robot", ROBOT), *((name, "f8") for name in (*_OF_FILTER, *_OWN))])
"""The numbers of a guide as compiled code takes them."""


class Guide:
    """Leads robots round what is in their way; see `Strength`.

    Args:
        filter_config: the settings of the filter that it proposes to.
        strength: how much it may do.
        config: its own settings.

    Raises:
        ValueError: for an unknown strength.
    """

    def __init__(
        self,
        filter_config: FilterConfig | None = None,
        strength: Strength = DEFAULT_STRENGTH,
        config: GuideConfig | None = None,
    ) -> None:
        if strength not in STRENGTHS:
            raise ValueError(f"guide must be one of {', '.join(STRENGTHS)}, got {strength!r}")
        self.strength = strength
        of_filter = settings(filter_config or FilterConfig())
        own = config or GuideConfig()
        self._settings = np.zeros(1, GUIDE)
        for name in ("robot", *_OF_FILTER):
            self._settings[name] = of_filter[name]
        for name in _OWN:
            self._settings[name] = getattr(own, name)

    def propose(self, step: Step) -> tuple[IntArray, FloatArray]:
        """The rows (n,) of the robots that are led, and the references (n, 2) in place of their actions."""
        memory = step.memory
        refused = step.active & ~step.certified
        wanted = step.active
        if self.strength == "off":
            wanted = np.zeros_like(refused)
        elif self.strength == "refusal":
            wanted = refused | (step.active & (memory["guided"] > 0))
        rows = np.flatnonzero(wanted)
        scene = step.scene
        memory["guided"][~wanted] = 0
        if not rows.size:
            return rows, np.empty((0, 2))
        leads = np.zeros(len(rows), np.bool_)
        engaged = np.zeros(len(rows), np.bool_)
        proposed = step.nominal[rows]
        blamed = np.empty(len(rows), np.int64)
        side = memory["side"][rows]
        lead(self._settings, scene.seen, scene.given, scene.readings, scene.goal, rows, refused, proposed, side, (memory['guided'][rows]==0)&(self.strength=='refusal'), blamed, leads, engaged)
        memory["side"][rows] = side
        memory["guided"][rows] = engaged
        led = rows[leads]
        step.name_hazard(led, blamed[leads])
        return led, proposed[leads]


@compiled
def _discs(config: Records, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray) -> int:
    """What to drive round: discs (x, y, radius) with the margin and a clearance; how many there are."""
    grown = config.hazard_radius + config.margin + config.clearance
    count = 0
    for i in range(given.shape[0]):
        x, y = given[i]
        if math.isnan(x):
            continue
        out[count, 0] = x
        out[count, 1] = y
        out[count, 2] = grown + config.bearing_error * math.hypot(x, y)
        source[count] = i
        count += 1
    if readings.size == 0:
        return count
    wanted = unexplained(readings, given, config.position_error, config.bearing_error)
    return likeliest(readings, wanted, grown, out, source, count, given.shape[0])


@compiled
def _way(
    config: Records,
    discs: FloatArray,
    count: int,
    goal: tuple[bool, float, float],
    state: State,
    nominal: FloatArray,
    refused: bool,
    side: int,
    fresh: bool,
) -> tuple[bool, bool, Path]:
    """Whether to lead a robot, and the way.

    It is led while a hazard stands in the straight way to the goal and the nominal action does not drive
    round it by itself, and also where the robot hardly moves and the nominal action is refused: such a robot
    would stay there.
    """
    seen, goal_x, goal_y = goal
    now = stopping(config.robot, state)
    way = shortest_path(discs, count, (goal_x, goal_y), (now.zx, now.zy), side, config.steadiness)
    if not seen:
        return False, False, way
    if way.blocker >= 0 and way.distance < config.lookahead:
        if fresh and math.hypot(now.zx, now.zy) > config.engage:
            return False, False, way
        return refused or not drives_round(config, discs, count, state, nominal, way), True, way
    leads = refused and math.hypot(now.zx, now.zy) < config.slow
    return leads, leads, way


def _lead_entry() -> Callable[..., None]:
    sources = SOURCES

    @entry
    def lead(
        settings: Records,
        seen: Records,
        given: FloatArray,
        readings: FloatArray,
        goals: FloatArray,
        rows: IntArray,
        refused: NDArray[np.bool_],
        proposed: FloatArray,
        side: NDArray[np.int8],
        fresh: NDArray[np.bool_],
        blamed: IntArray,
        leads: NDArray[np.bool_],
        engaged: NDArray[np.bool_],
    ) -> None:
        """Find the references of those robots that are to be led.

        Args:
            settings: (1,) of `GUIDE`.
            seen: (N,) of `filter.kernel.SEEN`.
            given: (N, n, 2) hazards [m].
            readings: (N, 16) the hazards' lidar, or (N, 0).
            goals: (N, 16) the goal's lidar.
            rows: (n,) which robots.
            refused: (N,) whether the nominal action has no certificate.
            proposed: (n, 2) the nominal actions u1, u2; overwritten where it leads.
            side: (n,) the remembered side, overwritten by the new one.
            blamed: (n,) receives the hazard, or n + the bin, that is in the way; -1 for none.
            leads: (n,) receives whether it leads.
        """
        if not sources:
            return
        config = settings[0]
        size = given.shape[1] + 16
        discs, source = np.empty((size, 3)), np.empty(size, dtype=np.int64)
        for j in range(len(rows)):
            k = rows[j]
            state = State(0.0, 0.0, 0.0, seen[k].vx, seen[k].vy, seen[k].yaw_rate)
            count = _discs(config, given[k], readings[k], discs, source)
            before = 1 if side[j] > 0 else (-1 if side[j] < 0 else 0)
            leads[j], engaged[j], way = _way(
                config, discs, count, decode_goal(goals[k]), state, proposed[j], refused[k], before, fresh[j]
            )
            blamed[j] = source[way.blocker] if way.blocker >= 0 else -1
            if way.side != 0:
                side[j] = way.side * SIDE_STEPS
            if leads[j]:
                thrust, turn = steer(config, discs, count, state, way.x, way.y)
                proposed[j, 0] = thrust * config.robot.force_limit
                proposed[j, 1] = turn

    return lead


lead = _lead_entry()
