"""The quadratic programme: the least change of the action that keeps every barrier from falling too fast.

The variables are the true inputs, x = (u1 / 0.05, u2): the share of full thrust, which saturates at 1, and
the turn.

    minimise   (x - r)^T P (x - r) / 2    subject to   G x <= h,   -1 <= x <= 1

r is the reference, P the weights. Row i says h_i(x+) >= a_i for obstacle i, where h_i is the clearance of a
backup manoeuvre (a backup control barrier function), x+ the state after one exact control step, and h_i(x+)
is linearised in the inputs about a point: the reference first, the last solution afterwards. The last row is
the circulation row: it turns the robot into the way past the obstacle. Building and solving are apart: see
`solvers`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from filter.config import Settings
from system.clearance import clearances
from system.compiled import compiled
from system.point_robot import State, Stopping, advance, stopping

FloatArray = NDArray[np.float64]

_PROBE = 0.5
"""Step of the finite differences, in the QP's variables: larger than the servo's chatter."""


@dataclass(frozen=True)
class Problem:
    """One QP in two variables.

    Attributes:
        weights: (2,) diagonal of P, positive.
        reference: (2,) r.
        G: (m, 2) rows.
        h: (m,) right-hand sides.
    """

    weights: FloatArray
    reference: FloatArray
    G: FloatArray
    h: FloatArray

    def residual(self, x: FloatArray) -> float:
        """Largest violation of a row, scaled to a normal of at least length 1, or of the box; 0 if none."""
        scale = np.maximum(np.linalg.norm(self.G, axis=1), 1.0)
        rows = ((self.G @ x - self.h) / scale).max(initial=0.0)
        return float(max(rows, (np.abs(x) - 1.0).max(), 0.0))

    def scaled(self) -> tuple[FloatArray, FloatArray]:
        """G and h with rows of length 1, which gives solvers' absolute tolerances a meaning."""
        length = np.maximum(np.linalg.norm(self.G, axis=1), 1e-9)
        return self.G / length[:, None], self.h / length


@compiled
def after(settings: Settings, state: State, thrust: float, turn: float) -> Stopping:
    """The reduced state after one exact control step with a share of full thrust and a turn."""
    robot = settings.robot
    return stopping(robot, advance(robot, state, thrust * robot.force_limit, turn, robot.substeps))


@compiled
def barrier_rows(
    settings: Settings,
    obstacles: FloatArray,
    count: int,
    state: State,
    now: FloatArray,
    about: FloatArray,
    backup: tuple[int, int],
    G: FloatArray,
    h: FloatArray,
    work: FloatArray,
) -> int:
    """Write the barrier rows of one robot's QP; how many there are.

    They are linearised about ``about`` (2,), for a ``backup`` and the steps that it thrusts after the step.
    ``now`` (>= M,) is each obstacle's clearance under the present state's best backup [m]; ``G`` (>= M, 2)
    and ``h`` (>= M,) receive the rows that can bind in the box; ``work`` (3, >= M) is scratch.
    """
    f, w = about
    df = _PROBE if f < 0.0 else -_PROBE
    dw = _PROBE if w < 0.0 else -_PROBE
    kind, steps = backup
    clearances(settings, kind, steps, obstacles, count, after(settings, state, f, w), work[0])
    clearances(settings, kind, steps, obstacles, count, after(settings, state, f + df, w), work[1])
    clearances(settings, kind, steps, obstacles, count, after(settings, state, f, w + dw), work[2])
    rows = 0
    for i in range(count):
        gf = (work[1, i] - work[0, i]) / df
        gw = (work[2, i] - work[0, i]) / dw
        bound = work[0, i] - gf * f - gw * w - asked(settings, now[i])
        if abs(gf) + abs(gw) > bound:
            G[rows, 0] = -gf
            G[rows, 1] = -gw
            h[rows] = bound
            rows += 1
    return rows


@compiled
def asked(settings: Settings, clearance: float) -> float:
    """What a barrier row asks of a clearance [m] after the step.

    It may lose a share of what it is above ``keep_off``. Below, it need not rise, for the backup's own action
    only keeps it.
    """
    lost: float = settings.rate * max(clearance - settings.keep_off, 0.0)
    return clearance - lost
