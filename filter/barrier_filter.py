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
from filter.solvers import make_solver
from filter.step import Step

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

LINEARISATIONS = (0.0, 0.0, 2.0, 0.0, 0.5, 0.1, 0.02)
"""How the QP is linearised, one after the other, until its solution is certified. 0: about the reference
first, about the last solution afterwards. Above 0: about the best backup's own action, which is feasible, and
the solution stays so near to it (2 leaves the whole box): a step is not smooth in the turn, whose servo
chatters, so that a linearisation may hold nearby only."""
_NOBODY = np.empty(0, np.int64)
_CHUNK = 512
"""Robots handled at once: bounds the memory of the obstacles."""


class Guide(Protocol):
    """Leads robots round what is in their way; `guide.Guide` is one."""

    def propose(self, step: Step) -> tuple[IntArray, FloatArray]:
        """The rows (n,) of the robots that are led, and the references (n, 2) in place of their actions."""


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
        refused = step.active & ~step.certified
        led: IntArray = _NOBODY
        if self.guide is not None:
            led, proposed = self.guide.propose(step)
            if led.size:
                step.send(led, proposed, Mode.GUIDED, Origin.GUIDE)
                refused[led] = ~step.certify(led, proposed, np.full(len(led), self.config.hysteresis))
        left = refused.nonzero()[0]
        if left.size:
            free = np.ones(len(nominal), np.bool_)
            free[led] = False
            step.blame(left, view.source[left, step.nearest(left)])
            # Where the best backup keeps less than any certificate needs, there is none to be found.
            hopeless = view.barrier[left] < step.need[left]
            hoped = left[~hopeless]
            hoped = self._by_search(step, self._by_qp(step, Programme(step, hoped, free[hoped])))
            self._fall_back(step, np.concatenate([left[hopeless], hoped]))
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
        return Programme(step, np.zeros(1, np.int64), step.active).problem() if step.refused else None

    def _by_qp(self, step: Step, programme: Programme) -> IntArray:
        """Send the QP's own solution where it is certified; the rows that are left."""
        for trust in LINEARISATIONS:
            if not programme.rows.size:
                break
            programme.linearise(trust)
            programme.solve(self._solver)
            rows, action = programme.rows, programme.action()
            done = programme.solved & step.certify(rows, action, step.need[rows])
            step.send(rows[done], action[done], Mode.FILTERED, Origin.BARRIER)
            circled = done & programme.circulates
            step.send(rows[circled], action[circled], Mode.FILTERED, Origin.CIRCULATION)
            programme.keep(~done)
        return programme.rows

    def _by_search(self, step: Step, rows: IntArray) -> IntArray:
        """Send the certified action nearest to the reference, of those that are tried; the rows left."""
        if not rows.size:
            return rows
        found = step.search(rows)
        done: BoolArray = step.certificates["clearance"][rows] >= step.need[rows]
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
