"""What one robot sees and was told, as a picture of it needs it: plain JSON, what is unknown null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import MEMORY, Decision
from filter import FilterConfig, FilterError
from monitor import Monitor
from pointgoal.observation import LIDAR_BINS, ObservationLayout, layout
from server.schema import ActRequest
from system.outlook import discs, goal, way
from system.point_robot import ROBOT

FloatArray = NDArray[np.float64]

MOST_HAZARDS = 64
"""Given hazards that are shown, the nearest ones."""
_LONGEST = 200
"""Control steps of a path, at most: from top speed a robot coasts for 2.2 s."""
_SPARSE = 3
"""Every so many control steps of a path are shown."""
_FIELD = 0.1
"""A magnetometer that shows less tells no heading; the task's field has 0.5."""


class Views:
    """Draws up views of robots that a monitor decides about. All of it is compiled when this is made.

    Args:
        monitor: what decides.
        config: the filter's settings, for the errors of the hazards' places.
    """

    def __init__(self, monitor: Monitor, config: FilterConfig) -> None:
        manifest = monitor.bundle.manifest
        self._monitor = monitor
        self._layout: ObservationLayout = layout(manifest.level)
        self._radius = manifest.hazard_radius
        self._errors = config.position_error, config.bearing_error
        self._robot = np.array([tuple(monitor.robot)], ROBOT)
        self._way = np.empty((_LONGEST, 2))
        self._discs, self._bins = np.empty((LIDAR_BINS, 3)), np.empty(LIDAR_BINS, np.int64)
        way(self._robot, np.zeros(3), np.zeros((1, 2)), self._way)
        self._likely(np.zeros(LIDAR_BINS), np.zeros((0, 2)))
        goal(np.zeros(LIDAR_BINS))

    def of(self, asked: ActRequest, decision: Decision) -> dict[str, Any]:
        """The view of a robot that asked, and about whom was decided so.

        All places are in the robot's own frame when its action takes effect, x ahead and y to the left [m].

        Returns:
            heading: from the magnetometer [rad], 0 where the field points to the right; null without one.
            velocity: ahead and to the left [m/s]; yaw_rate [rad/s].
            goal: where it is; null out of its lidar's range.
            radius: a hazard's [m].
            given: hazards (x, y, number) that the robot named, the nearest `MOST_HAZARDS`.
            likely: discs (x, y, number) as the lidar tells them apart beside those: a guess.
            obstacles: where the filter lets no path go, (x, y, dx, dy, radius, growth, number): discs whose
                radius grows along a segment; those within reach.
            blamed: the number of the hazard behind an intervention, or null.
            nominal, action: the actions; null if there was no nominal one.
            path: places on the way of the action and the committed plan; null if no plan is committed.
            problem: why the rest is unknown, or null.
        """
        observation = np.array(asked.observation)
        given = np.array(asked.hazards or [], np.float64).reshape(-1, 2)
        # What was under way when it asked: all that it was sent but this action.
        memory = np.zeros(1, MEMORY)
        memory["history"]["sent"][0, :-1] = decision.memory["history"]["sent"][1:]
        try:
            scene = self._monitor.look(observation[None], given[None], memory)
        except (FilterError, ValueError) as error:
            return {"problem": str(error)}
        seen = scene.seen[0]
        at = seen["x"].item(), seen["y"].item(), seen["heading"].item()
        count = int(seen["count"])
        motion = np.array([seen["vx"], seen["vy"], seen["yaw_rate"]])
        nearest = np.argsort(np.hypot(*given.T), kind="stable")[:MOST_HAZARDS]
        heading = _heading(self._block(observation, "magnetometer"))
        in_range, *place = goal(self._block(observation, "goal_lidar"))
        return {
            "heading": None if heading is None else heading + at[2],
            "velocity": _rounded(motion[:2]),
            "yaw_rate": _rounded(motion[2]),
            "goal": _rounded(_own(np.array([place]), at))[0] if in_range else None,
            "radius": self._radius,
            "given": _numbered(_own(given[nearest], at), nearest),
            "likely": _numbered(*self._of_scan(scene.readings[0], given, at)),
            "obstacles": _numbered(scene.obstacles[0, :count, :6], scene.source[0, :count]),
            "blamed": decision.hazard,
            "nominal": _known(decision.nominal_action),
            "action": _known(decision.action),
            "path": self._path(motion, decision),
            "problem": None,
        }

    def _of_scan(
        self, readings: FloatArray, given: FloatArray, at: tuple[float, float, float]
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        if not readings.size:
            return np.empty((0, 2)), np.empty(0, np.int64)
        found = self._likely(np.ascontiguousarray(readings), given)
        return _own(self._discs[:found, :2], at), self._bins[:found]

    def _likely(self, readings: FloatArray, given: FloatArray) -> int:
        return discs(readings, given, *self._errors, self._radius, self._discs, self._bins)

    def _path(self, motion: FloatArray, decision: Decision) -> list[Any] | None:
        if not decision.memory["planned"]:
            return None
        actions = np.vstack([decision.action, decision.plan])
        count = way(self._robot, motion, actions, self._way)
        # The last place is shown as well.
        return [[0.0, 0.0], *_rounded(self._way[(count - 1) % _SPARSE : count : _SPARSE])]

    def _block(self, observation: FloatArray, name: str) -> FloatArray:
        block: FloatArray = observation[self._layout.slice(name)]
        return block


def _heading(field: FloatArray) -> float | None:
    """The heading [rad] in the plane in which the field points along -y; None where there is no field."""
    ahead, left = field[:2].tolist()
    return None if math.hypot(ahead, left) < _FIELD else math.atan2(-ahead, -left)


def _own(places: FloatArray, at: tuple[float, float, float]) -> FloatArray:
    """Places (n, 2) as a robot has them that is at (x, y, heading)."""
    cos, sin = math.cos(at[2]), math.sin(at[2])
    own: FloatArray = (places - at[:2]) @ np.array([[cos, -sin], [sin, cos]])
    return own


def _numbered(rows: FloatArray, numbers: ArrayLike) -> list[list[float]]:
    told: list[list[float]] = _rounded(rows)
    return [[*row, int(number)] for row, number in zip(told, np.asarray(numbers), strict=True)]


def _rounded(values: ArrayLike) -> Any:
    """To tenths of a millimetre: a picture shows no more."""
    return np.round(np.asarray(values, np.float64), 4).tolist()


def _known(action: FloatArray) -> list[float] | None:
    return _rounded(action) if np.isfinite(action).all() else None
