"""The filter: nominal action in, certified action out. A batch at a time; one robot is a batch of one."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import Decisions, Memory, Mode, Origin
from filter import kernel, scene
from filter.config import FilterConfig, settings
from filter.programme import Programme
from filter.qp import Problem
from filter.scene import Scene
from filter.solvers import make_solver, planar
from filter.step import Led, Step

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_CHUNK = 512
"""Robots handled at once: bounds the memory of the obstacles."""


class Guide(Protocol):
    """Leads robots round what is in their way; `guide.Guide` is one."""

    def propose(self, step: Step) -> Led | None:
        """Who is led, and by which references in place of their actions; None: nobody."""


class BarrierFilter:
    """Turns nominal actions into certified ones.

    It keeps nothing between calls: what is remembered of a robot is passed in and out, so one filter serves
    any number of robots, and a batch of N gives what N single calls give.

    Args:
        config: the settings.
        guide: who leads robots round what is in their way; None: nobody does.

    Raises:
        ValueError: if the configuration names a solver that is not installed.
    """

    def __init__(self, config: FilterConfig | None = None, guide: Guide | None = None) -> None:
        self.config = FilterConfig() if config is None else config
        self.guide = guide
        self._settings = settings(self.config)
        self._solver = make_solver(self.config.solver)

    def filter(
        self,
        observation: ArrayLike,
        nominal_action: ArrayLike,
        hazards: ArrayLike | None = None,
        memory: Memory | None = None,
        active: ArrayLike | None = None,
    ) -> Decisions:
        """Filter N actions.

        Args:
            observation: (N, 60), or (N, 28) at level 0.
            nominal_action: (N, 2), clipped to ±1.
            hazards: (N, n, 2) centres in the body frame, x ahead and y to the left [m]; rows of NaN are
                absent ones. What the lidar shows beside them counts as well; None or none: the lidar alone.
            memory: (N,) of `MEMORY`, what the last call returned; None before the first.
            active: (N,) where False, the nominal action passes as it is. None: all True.

        Raises:
            FilterInputError: if an input has a wrong shape or a value that is not finite.
        """
        seen = scene.check_observation(observation)
        n = len(seen)
        nominal = scene.check_action(nominal_action, n)
        given = scene.check_hazards(hazards, n)
        gate = scene.check_active(active, n)
        past = scene.check_memory(memory, n)
        if n <= _CHUNK:
            decisions = self.decide(scene.look(self._settings, seen, given, past), nominal, past, gate)
        else:
            parts = []
            for start in range(0, n, _CHUNK):
                part = slice(start, start + _CHUNK)
                near = None if given is None else given[part]
                view = scene.look(self._settings, seen[part], near, past[part])
                parts.append(self.decide(view, nominal[part], past[part], gate[part]))
            decisions = Decisions.join(parts)
        if active is not None:
            decisions.opened_by = np.where(gate, decisions.opened_by, "")
        return decisions

    def look(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Scene:
        """What N robots see, and the barrier; arguments and errors as for `filter`."""
        seen = scene.check_observation(observation)
        n = len(seen)
        near, past = scene.check_hazards(hazards, n), scene.check_memory(memory, n)
        return scene.look(self._settings, seen, near, past)

    def decide(self, view: Scene, nominal: FloatArray, memory: Memory, active: BoolArray) -> Decisions:
        """Filter N actions for what is seen; arguments as for `filter`, all of them there and checked.

        Why the gate is open or closed is the caller's to say: the decisions say "always".
        """
        doubtful = np.count_nonzero(view.doubted) > 0
        step = Step(self._settings, view, nominal, memory, active & ~view.doubted if doubtful else active)
        led = None if self.guide is None else self.guide.propose(step)
        if step.refused or led is not None:
            hoped, hopeless = step.settle(led, self._solver is planar)
            if hoped.size and self._solver is not planar:
                hoped = self._by_qp(step, hoped, led)
            if hoped.size or hopeless.size:
                self._fall_back(step, np.concatenate([hopeless, self._by_search(step, hoped)]))
        if doubtful:
            step.distrust((active & view.doubted).nonzero()[0])
        return step.decisions()

    def problem(
        self, observation: ArrayLike, nominal_action: ArrayLike, hazards: ArrayLike | None = None
    ) -> Problem | None:
        """The first QP of one robot without memory, None if its action passes; arguments as for `filter`."""
        given = None if hazards is None else np.asarray(hazards)[None]
        view = self.look(np.asarray(observation)[None], given)
        nominal = scene.check_action(np.asarray(nominal_action)[None], 1)
        step = Step(self._settings, view, nominal, scene.check_memory(None, 1), np.ones(1, np.bool_))
        return Programme(step, 0, circulating=True).problem(trust=0.0) if step.refused else None

    def _by_qp(self, step: Step, rows: IntArray, led: Led | None) -> IntArray:
        """Send what another solver than ours makes of the QPs, where certified; the rows that are left."""
        for k in rows:
            outcome, action = Programme(step, k, led is None or not led.which[k]).run(self._solver)
            if outcome != kernel.OPEN:
                origin = Origin.CIRCULATION if outcome == kernel.CIRCULATION else Origin.BARRIER
                step.send(np.array([k]), action, Mode.FILTERED, origin)
                rows = rows[rows != k]
        return rows

    def _by_search(self, step: Step, rows: IntArray) -> IntArray:
        """Send the certified action nearest to the reference, of those that are tried; the rows left."""
        if not rows.size:
            return rows
        found, done = step.search(rows)
        step.send(rows[done], found[done], Mode.FILTERED, Origin.SEARCH)
        return rows[~done]

    def _fall_back(self, step: Step, rows: IntArray) -> None:
        """Send what keeps the inner margin, else what is left of the plan, else what does the least harm."""
        if not rows.size:
            return
        found, outcome = step.recover(rows)
        kept, inside = outcome == kernel.COMMITTED, outcome == kernel.INSIDE
        # A scan can leave places possible that the last one had ruled out, and then no backup keeps out of
        # them all. The plan was certified against those possible then, and the hazards are among them.
        planned = ~kept & ~inside & step.by_scan(rows) & step.has_plan(rows)
        for which, origin, reason in (
            (kept, Origin.PLAN, "no certified action: committed backup"),
            (inside, Origin.HARM, "inside a hazard: driving out"),
            (~kept & ~inside & ~planned, Origin.HARM, "too fast to stay clear of a hazard: least harm"),
        ):
            step.send(rows[which], found[which], Mode.FALLBACK, origin, reason)
        step.forget(rows[~kept & ~planned])
        step.go_on(rows[planned], "no certified action: the plan goes on")
