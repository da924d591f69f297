"""The filter's own speed: ``python -m benchmarks.filter``.

Prints the median time of a single decision by the number of hazards, for those decisions on which the filter
acts; of a batch, as decisions a second on one core; and of each QP solver, with its residual, side by side.
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import qpsolvers
import tyro
from numpy.typing import NDArray

from decision import Mode
from filter import BarrierFilter, FilterConfig
from filter.errors import SolverError
from filter.qp import Problem
from filter.solvers import make_solver, planar
from guide import Guide
from pointgoal import seeds
from pointgoal.lidar import encode
from pointgoal.observation import layout
from pointgoal.seeds import Use

FloatArray = NDArray[np.float64]


@dataclass
class Arguments:
    """How long to measure."""

    scenes: int = 300
    """Random scenes for each number of hazards."""
    repeats: int = 15
    """Times that each is measured; the median counts."""
    hazards: tuple[int, ...] = (2, 8, 25, 50, 100, 200)
    """Numbers of hazards."""
    batch: int = 4096
    """Robots in a batch."""


def _ahead(solver: str = "planar") -> BarrierFilter:
    """A filter whose guide leads ahead, so that one of them acts on most scenes."""
    return BarrierFilter(FilterConfig(solver=solver), Guide(strength="ahead"))


def scenes(n: int, hazards: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Random situations: observations (n, 60), nominal actions (n, 2), hazards (n, k, 2) in the body frame.

    The nearest hazard is ahead and near, so that the filter mostly acts; the density of the others is that of
    level 1 up to 25 hazards, and grows from there on, so that more and more of them are within reach.
    """
    spread = 1.5 * np.sqrt(min(hazards, 25) / 8.0)
    places = rng.uniform(-spread, spread, (n, hazards, 2))
    bearing, distance = rng.uniform(-0.5, 0.5, n), rng.uniform(0.25, 0.5, n)
    places[:, 0] = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    away = np.maximum(np.linalg.norm(places, axis=2, keepdims=True), 1e-9)
    places *= np.maximum(0.25 / away, 1.0)
    observation = np.zeros((n, layout(1).size))
    observation[:, 3] = rng.uniform(0.0, 0.7, n)
    observation[:, 8] = rng.uniform(-3.0, 3.0, n)
    observation[:, layout(1).slice("goal_lidar")] = encode(rng.uniform(-1.5, 1.5, (n, 1, 2)))
    observation[:, layout(1).slice("hazards_lidar")] = encode(places)
    action = np.stack([np.ones(n), rng.uniform(-1.0, 1.0, n)], axis=1)
    return observation, action, places


def median_us(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a call [us]."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e6 * statistics.median(times)


def _decisions(
    robot_filter: BarrierFilter, arguments: Arguments, hazards: int, given: bool
) -> tuple[float, float, float]:
    """Median time of a decision [us] on which the filter acts, its 99th percentile, and how often it acts."""
    rng = seeds.generator(Use.FILTER_SPEED, hazards)
    observation, action, places = scenes(arguments.scenes, hazards, rng)
    times = []
    for k in range(arguments.scenes):
        row = slice(k, k + 1)
        known = places[row] if given else None
        if robot_filter.filter(observation[row], action[row], known).mode[0] == Mode.NOMINAL:
            continue

        def decide(row: slice = row, known: FloatArray | None = known) -> Any:
            return robot_filter.filter(observation[row], action[row], known)

        times.append(median_us(decide, arguments.repeats))
    return float(np.median(times)), float(np.percentile(times, 99)), len(times) / arguments.scenes


def _single(arguments: Arguments) -> None:
    print("single decision on which the filter acts, default solver [us]")
    print(f"{'hazards':>8s} {'median':>8s} {'p99':>8s} {'acts':>6s}")
    for count in arguments.hazards:
        median, tail, share = _decisions(_ahead(), arguments, count, given=True)
        print(f"{count:8d} {median:8.1f} {tail:8.1f} {share:6.2f}", flush=True)
    median, tail, share = _decisions(_ahead(), arguments, 8, given=False)
    print(f"{'lidar':>8s} {median:8.1f} {tail:8.1f} {share:6.2f}")


def _batched(arguments: Arguments) -> None:
    print("\nbatch on one core [decisions a second]")
    rng = seeds.generator(Use.FILTER_SPEED, 0)
    observation, action, places = scenes(arguments.batch, 8, rng)
    robot_filter = _ahead()
    for name, known in (("given", places), ("lidar", None)):
        spent = median_us(lambda known=known: robot_filter.filter(observation, action, known), 5)  # type: ignore[misc]
        print(f"{name:>8s} {arguments.batch / spent * 1e6:10.0f}   (the filter acts on nearly all of them)")


def _problems(arguments: Arguments) -> list[Problem]:
    rng = seeds.generator(Use.FILTER_SPEED, 1)
    observation, action, places = scenes(4 * arguments.scenes, 8, rng)
    robot_filter = BarrierFilter()
    found = [robot_filter.problem(*one) for one in zip(observation, action, places, strict=True)]
    return [problem for problem in found if problem is not None][: arguments.scenes]


def _solvers(arguments: Arguments) -> None:
    problems = _problems(arguments)
    references = [planar(problem) for problem in problems]
    print(f"\nsolvers on {len(problems)} QPs that the filter built (2 variables), and in whole decisions")
    print(f"{'':>10s} {'us':>8s} {'residual':>9s} {'differs':>9s} {'failed':>7s} {'decision':>9s}")
    for name in ["planar", "osqp", *sorted(set(qpsolvers.available_solvers) - {"osqp"})]:
        solve = make_solver(name)
        times, residual, differs, failed = [], 0.0, 0.0, 0
        for problem, reference in zip(problems, references, strict=True):
            try:
                x = solve(problem)
            except SolverError:
                failed += 1
                continue
            times.append(median_us(lambda solve=solve, problem=problem: solve(problem), 3))  # type: ignore[misc]
            if (x is None) != (reference is None):
                failed += 1
            elif x is not None and reference is not None:
                residual = max(residual, problem.residual(x))
                differs = max(differs, float(np.abs(x - reference).max()))
        decision = _decisions(_ahead(name), arguments, 8, given=True)[0]
        print(
            f"{name:>10s} {statistics.median(times):8.1f} {residual:9.1e} {differs:9.1e} {failed:7d} "
            f"{decision:9.1f}",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    arguments = tyro.cli(Arguments)
    warnings.simplefilter("ignore")
    _single(arguments)
    _batched(arguments)
    _solvers(arguments)


if __name__ == "__main__":
    main()
