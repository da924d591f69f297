"""Who is led, and by which reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter import FilterConfig, Led, Step
from filter.config import settings
from guide.path import Path, drives_round, shortest_path, steer
from pointgoal.observation import LIDAR_BINS
from system.compiled import compiled, entry
from system.lidar import decode_goal, likeliest, unexplained
from system.point_robot import ROBOT, State, stopping
from system.surroundings import in_own_frame

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Records = NDArray[np.void]

Strength = Literal["off", "refusal", "ahead"]
"""How much a guide may do. off: nothing. refusal: lead a robot whose nominal action has no certificate, until
it is past what is in its way. ahead: lead every robot that has something in its way and does not drive round
it by itself: a planner drives then, and most of the actions that it replaces have a certificate."""
STRENGTHS: tuple[Strength, ...] = get_args(Strength)
DEFAULT_STRENGTH: Strength = "ahead"


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
    slow: float = 0.15
    """A robot whose stop point is nearer than this hardly moves [m]: from a refusal on, it is led; one that
    moves is the filter's first. It is also led where nothing is in its way and it is refused all the same."""

    def __post_init__(self) -> None:
        """Refuse settings that lead nowhere."""
        for name in ("lookahead", "clearance", "pursuit", "eagerness"):
            if not 0.0 < getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in (0, 100), got {getattr(self, name)!r}")
        for name in ("repulsion", "steadiness", "slow"):
            if not 0.0 <= getattr(self, name) < 100.0:
                raise ValueError(f"{name} must be in [0, 100), got {getattr(self, name)!r}")


_OWN = tuple(GuideConfig.__dataclass_fields__)
_OF_FILTER = ("margin", "position_error", "bearing_error", "hazard_radius")
GUIDE = np.dtype([("robot", ROBOT), *((name, "f8") for name in (*_OF_FILTER, *_OWN))], align=True)
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

    def propose(self, step: Step) -> Led | None:
        """Who is led, and by which references in place of their actions; None: nobody."""
        scene, memory, ahead = step.scene, step.memory, self.strength == "ahead"
        if not ahead and (self.strength == "off" or not (step.refused or memory["guided"].any())):
            return None
        n = len(scene)
        led = Led(np.empty(n, np.bool_), step.nominal.copy(), np.empty(n, np.int64))
        seen = self._settings, scene.seen, scene.observation, scene.columns, scene.given
        return led if lead(*seen, step.active, step.certified, ahead, memory, *led) else None


@compiled
def _discs(config: Any, given: FloatArray, readings: FloatArray, out: FloatArray, source: IntArray) -> int:
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
def _leads(
    config: Any,
    discs: FloatArray,
    count: int,
    goal: tuple[bool, float, float],
    state: State,
    nominal: FloatArray,
    refused: bool,
    engaged: bool,
    ahead: bool,
    side: int,
) -> tuple[bool, bool, Path]:
    """Whether to lead a robot in this step, whether it is still being led past something, and the way.

    It is led while a hazard stands in the straight way to the goal and the nominal action does not drive
    round it by itself; at strength ahead also where the robot hardly moves and the nominal action is refused,
    for such a robot would stay there. Whoever moves when the first action is refused is the filter's.
    """
    seen, goal_x, goal_y = goal
    now = stopping(config.robot, state)
    way = shortest_path(discs, count, (goal_x, goal_y), (now.zx, now.zy), side, config.steadiness)
    hardly = math.hypot(now.zx, now.zy) < config.slow
    if not (seen and way.blocker >= 0 and way.distance < config.lookahead):
        return ahead and seen and refused and hardly, False, way
    if not (engaged or (refused and hardly)):
        return False, False, way
    return refused or not drives_round(config, discs, count, state, nominal, way), True, way


@entry
def lead(
    settings: Records,
    seen: Records,
    observation: FloatArray,
    columns: tuple[int, int, int, int, int],
    given: FloatArray,
    active: NDArray[np.bool_],
    certified: NDArray[np.bool_],
    ahead: bool,
    memory: Records,
    led: NDArray[np.bool_],
    proposed: FloatArray,
    hazard: IntArray,
) -> bool:
    """Find the references of those of N robots that are led; whether anyone is.

    Args:
        settings: (1,) of `GUIDE`.
        seen: (N,) of `filter.kernel.SEEN`.
        observation: (N, O).
        columns: as for `filter.kernel.see`.
        given: (N, n, 2) hazards [m].
        active: (N,) who may be led.
        certified: (N,) whose nominal action has a certificate.
        ahead: whether to lead whoever has something in the way, refused or not.
        memory: (N,) of `MEMORY`: the side on which a robot is being led past something is overwritten.
        led: (N,) receives who is led.
        proposed: (N, 2) the nominal actions u1, u2; overwritten where it leads.
        hazard: (N,) receives the hazard, or n + the bin, that is in the way of a robot that is led, else -1.
    """
    config = settings[0]
    _, _, first, last, goal = columns
    anyone, size = False, given.shape[1] + LIDAR_BINS
    discs, source = np.empty((size, 3)), np.empty(size, dtype=np.int64)
    for k in range(len(seen)):
        past = memory[k]
        led[k], hazard[k] = False, -1
        if not (active[k] and (ahead or past.guided != 0 or not certified[k])):
            past.guided = 0
            continue
        state = State(0.0, 0.0, 0.0, seen[k].vx, seen[k].vy, seen[k].yaw_rate)
        count = _discs(config, given[k], observation[k, first:last], discs, source)
        at = decode_goal(observation[k, goal : goal + LIDAR_BINS])
        # Seen where the robot was observed; it drives from where its next action takes effect.
        there = State(seen[k].x, seen[k].y, seen[k].heading, 0.0, 0.0, 0.0)
        if there.x != 0.0 or there.y != 0.0 or there.heading != 0.0:
            for i in range(count):
                discs[i, 0], discs[i, 1] = in_own_frame(discs[i, 0], discs[i, 1], there)
            goal_x, goal_y = in_own_frame(at[1], at[2], there)
            at = (at[0], goal_x, goal_y)
        engaged = ahead or past.guided != 0
        leads, past_it, way = _leads(
            config, discs, count, at, state, proposed[k], not certified[k], engaged, ahead, past.guided
        )
        past.guided = way.side if past_it else 0
        if leads:
            led[k] = anyone = True
            hazard[k] = source[way.blocker] if way.blocker >= 0 else -1
            thrust, turn = steer(config, discs, count, state, way.x, way.y)
            proposed[k, 0] = thrust * config.robot.force_limit
            proposed[k, 1] = turn
    return anyone
