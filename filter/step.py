"""One control step of N robots while the filter works on it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from decision import MEMORY, Decisions, Memory, Mode, OpenedBy, Origin, next_of_plan, texts, unknown
from filter import kernel
from filter.scene import DOUBT, Scene
from pointgoal.observation import LIDAR_RANGE
from system.backups import braking
from system.certificate import CERTIFICATE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@lru_cache(maxsize=64)
def _nowhere(n: int) -> IntArray:
    made = np.full(n, -1)
    made.setflags(write=False)
    return made


_NOBODY = np.empty(0, np.int64)
_MODES = np.concatenate(
    [texts(mode, 1) for mode in (Mode.NOMINAL, Mode.GUIDED, *[Mode.FILTERED] * 2, *[Mode.FALLBACK] * 2)]
)
_ORIGINS = np.concatenate(
    [
        texts(origin, 1)
        for origin in ("", Origin.GUIDE, Origin.BARRIER, Origin.CIRCULATION, *[Origin.HARM] * 2)
    ]
)
"""What each outcome of `kernel.settle` is called."""


class Led(NamedTuple):
    """Who of N robots a guide leads.

    Attributes:
        which: (N,) who.
        action: (N, 2) the references in place of their actions, and the nominal actions of the others.
        hazard: (N,) what is in the way of those who are led, -1 for nothing.
    """

    which: BoolArray
    action: FloatArray
    hazard: IntArray


class Step:
    """What is to be sent, and why, as far as it is decided; at first the nominal actions, screened.

    Attributes:
        settings: (1,) of `filter.config.SETTINGS`.
        scene: what is seen.
        nominal: (N, 2) u1, u2.
        action: (N, 2) what is to be sent.
        active: (N,) where the filter may change it.
        certificates: (N,) of `CERTIFICATE`, the last one looked for: in the end that of ``action``.
        certified: (N,) whether the nominal action has one.
        refused: how many of the active ones have none.
        memory: (N,) of `MEMORY`, becomes the next call's.
    """

    def __init__(
        self, settings: NDArray[np.void], scene: Scene, nominal: FloatArray, memory: Memory, active: BoolArray
    ) -> None:
        n = len(nominal)
        self.settings, self.scene = settings, scene
        self.nominal = self.action = nominal
        self.active = active
        self.certificates, self.certified = np.empty(n, CERTIFICATE), np.empty(n, np.bool_)
        self.memory, self._before = np.empty(n, MEMORY), memory
        self._mode, self._origin = texts(Mode.NOMINAL, n), texts("", n)
        self._hazard = _nowhere(n)
        self._reason: list[str | None] = [None] * n
        # Whose plans are still to be written down.
        self._open: BoolArray | None = None
        told = self.certificates, self.certified, memory, self.memory
        self.refused = kernel.screen(settings, scene.seen, scene.obstacles, nominal, active, *told)

    def settle(self, led: Led | None, own: bool) -> tuple[IntArray, IntArray]:
        """Decide about those who are led, and those whose actions have no certificate.

        With ``own``, our own solver solves the QPs; else nobody does.

        Returns:
            The rows that are left: for whom there may be a certified action, and for whom there is none.
        """
        n, scene = len(self.nominal), self.scene
        if led is None:
            led = Led(np.zeros(n, np.bool_), self.nominal.copy(), np.full(n, -1))
        self.action, self._hazard, outcome = led.action, led.hazard, np.empty(n, np.int8)
        seen = self.settings, scene.seen, scene.obstacles, scene.source
        left = kernel.settle(
            *seen,
            self.active,
            self.certified,
            led.which,
            own,
            self.action,
            self._hazard,
            self.certificates,
            self.memory,
            outcome,
        )
        self._mode, self._origin = _MODES[outcome], _ORIGINS[outcome]
        if not left:
            return _NOBODY, _NOBODY
        return (outcome == kernel.OPEN).nonzero()[0], (outcome == kernel.HOPELESS).nonzero()[0]

    def certify(self, k: int, action: FloatArray) -> bool:
        """Whether an action (2,) is certified in place of robot k's, which was refused."""
        scene, least = self.scene, kernel.needed(self.settings, self.scene.seen, k)
        seen = self.settings, scene.seen, scene.obstacles
        return bool(kernel.certify(*seen, k, action, least, self.certificates))

    def search(self, rows: IntArray) -> tuple[FloatArray, BoolArray]:
        """The certified actions (n, 2) of a grid nearest to some rows', and whether there is one (n,)."""
        scene, found, done = self.scene, self.action[rows], np.empty(len(rows), np.bool_)
        kernel.search(self.settings, scene.seen, scene.obstacles, rows, found, self.certificates, done)
        return found, done

    def recover(self, rows: IntArray) -> tuple[FloatArray, NDArray[np.int8]]:
        """Actions (n, 2) that leave the most clearance or lead out, and what they are (n,): see `kernel`."""
        scene, found = self.scene, np.empty((len(rows), 2))
        outcome = np.empty(len(rows), np.int8)
        radius = self.settings["hazard_radius"][0]
        with np.errstate(invalid="ignore"):
            seen = scene.seen[rows]
            away = np.hypot(*(scene.given[rows] - np.stack([seen["x"], seen["y"]], 1)[:, None]).T).T
        edge = np.fmin.reduce(away, axis=1, initial=np.inf)
        if scene.readings.shape[1]:
            # A scan tells how far the nearest hazard is, though not where.
            edge = np.minimum(edge, LIDAR_RANGE * (1.0 - scene.readings[rows].max(axis=1)))
        kernel.recover(
            self.settings, scene.seen, scene.obstacles, rows, edge - radius, found, self.certificates, outcome
        )
        return found, outcome

    def by_scan(self, rows: IntArray) -> BoolArray:
        """Whether what bounds some rows' best backups is a place that a scan leaves possible (n,)."""
        at = np.maximum(self.scene.seen["now"]["nearest"][rows], 0)
        return np.asarray(self.scene.source[rows, at] >= self.scene.given.shape[1])

    def send(
        self, rows: IntArray, action: FloatArray, mode: Mode, origin: Origin, reason: str | None = None
    ) -> None:
        """Send another action (n, 2) to some rows' robots than the nominal one."""
        if not rows.size:
            return
        if self._open is None:
            self._open = np.zeros(len(self.action), np.bool_)
            if self.action is self.nominal:
                self.action = self.nominal.copy()
                self._mode, self._origin = self._mode.copy(), self._origin.copy()
        self.action[rows] = action
        self._mode[rows] = mode
        self._origin[rows] = origin
        self._open[rows] = True
        for k in rows if reason is not None else ():
            self._reason[k] = reason

    def has_plan(self, rows: IntArray) -> BoolArray:
        """Which of some rows' robots came with a certified plan (n,)."""
        return np.asarray(self._before["planned"][rows])

    def go_on(self, rows: IntArray, reason: str) -> None:
        """Send the next action of some rows' plans."""
        if rows.size:
            action, after = next_of_plan(self._before[rows])
            after["history"] = self.memory["history"][rows]
            self.memory[rows] = after
            self.send(rows, action, Mode.FALLBACK, Origin.PLAN, reason)
            self._settled(rows)

    def distrust(self, rows: IntArray) -> None:
        """Of scans that contradict themselves nothing follows: some rows' plans go on, else they brake."""
        planned = self.has_plan(rows)
        self.go_on(rows[planned], f"{DOUBT}: the plan goes on")
        rest = rows[~planned]
        brake = braking(self.settings["robot"][0], self.scene.seen["vx"][rest])
        self.send(rest, brake, Mode.FALLBACK, Origin.HARM, f"{DOUBT}: braking")
        self.forget(rest)

    def forget(self, rows: IntArray) -> None:
        """Leave some rows without a plan."""
        self.memory["planned"][rows] = False
        self.memory["left"][rows] = 0
        self._settled(rows)

    def _settled(self, rows: IntArray) -> None:
        """Some rows' memory is as it is to be."""
        if self._open is not None:
            self._open[rows] = False

    def decisions(self) -> Decisions:
        """The step, decided, and the plans that the certificates end in written down."""
        n, memory = len(self.action), self.memory
        if self._open is not None:
            sent = self._open, self.action, self.certificates
            kernel.keep_plans(self.settings, self.scene.seen, *sent, memory)
        return Decisions(
            action=self.action,
            nominal_action=self.nominal,
            mode=self._mode,
            origin=self._origin,
            certified=self.certified,
            barrier=self.scene.barrier,
            hazard=self._hazard,
            reason=self._reason,
            risk=unknown(n),
            threshold=math.nan,
            opened_by=texts(OpenedBy.ALWAYS, n),
            novelty=unknown(n),
            suspect=texts("", n),
            memory=memory,
        )
