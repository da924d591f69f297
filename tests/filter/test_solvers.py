"""The solvers of the QP agree, on what has a solution and on what has none."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from filter import BarrierFilter, FilterConfig, SolverError
from filter.qp import Problem
from filter.solvers import KeptOSQP, make_solver, planar, solve

WEIGHTS = np.array([4.0, 1.0])


def random_problem(rng):
    """Rows of any size about a point or about nothing: about half of them cannot be met."""
    m = rng.integers(0, 13)
    G = rng.normal(size=(m, 2)) * rng.choice([0.01, 0.1, 1.0], size=(m, 1))
    h = 0.1 * rng.normal(size=m) + rng.choice([0.0, 0.1])
    return Problem(WEIGHTS * rng.uniform(0.5, 2.0, 2), rng.uniform(-1.5, 1.5, 2), G, h)


@pytest.fixture(scope="module")
def recorded(robot_filter, draw_scene):
    """QPs that the filter builds in random scenes."""
    rng = np.random.default_rng(5)
    problems = []
    while len(problems) < 1000:
        observation, action, hazards = draw_scene(rng)
        problem = robot_filter.problem(observation, action, hazards if len(problems) % 2 else None)
        if problem is not None:
            problems.append(problem)
    return problems


def test_two_solvers_agree_on_10000_problems(recorded):
    rng = np.random.default_rng(0)
    problems = [random_problem(rng) for _ in range(9000)] + recorded
    other = make_solver("quadprog")
    infeasible = []
    for index, problem in enumerate(problems):
        ours, theirs = planar(problem), other(problem)
        assert (ours is None) == (theirs is None)
        if ours is None:
            infeasible.append(index)
            continue
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-5)
        assert problem.residual(ours) <= 1e-9
    # Both kinds, among the random ones and among the filter's own.
    assert len(problems) == 10_000
    assert 2000 < np.sum(np.array(infeasible) < 9000) < 7000
    assert 50 < np.sum(np.array(infeasible) >= 9000) < 950


@pytest.mark.parametrize(("name", "count"), [("daqp", 500), ("osqp", 150)])
def test_other_solvers_agree(recorded, name, count):
    rng = np.random.default_rng(1)
    solve = make_solver(name)
    gave_up = 0
    for problem in [random_problem(rng) for _ in range(count)] + recorded[:count]:
        ours = planar(problem)
        try:
            theirs = solve(problem)
        except SolverError:
            gave_up += 1  # OSQP does, rarely; the filter then goes on without it
            continue
        assert (ours is None) == (theirs is None)
        if ours is not None:
            np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert gave_up <= 2


@pytest.mark.parametrize("name", ["planar", "daqp", "quadprog", "osqp"])
@pytest.mark.parametrize(
    ("G", "h"),
    [
        ([[1.0, 0.0], [-1.0, 0.0]], [-0.2, -0.2]),  # two rows against each other
        ([[1.0, 0.0]], [-1.5]),  # a row against the box
        ([[1.0, 1.0], [-1.0, 0.2], [0.2, -1.0]], [-0.6, -0.5, -0.5]),  # three, of which any two can be met
        ([[0.02, 0.0], [-0.02, 0.0]], [-0.004, -0.004]),  # short rows
    ],
)
def test_an_infeasible_problem_is_none_for_each(name, G, h):
    problem = Problem(WEIGHTS, np.array([0.3, -0.2]), np.array(G), np.array(h))
    assert make_solver(name)(problem) is None


@pytest.mark.parametrize("name", ["planar", "daqp", "quadprog", "osqp"])
def test_a_feasible_problem_is_solved_by_each(name):
    # 1 <= x + y / 2, from (0, 0): along P^-1 a, which prefers the turn.
    problem = Problem(WEIGHTS, np.zeros(2), np.array([[-1.0, -0.5]]), np.array([-0.4]))
    np.testing.assert_allclose(make_solver(name)(problem), [0.2, 0.4], atol=1e-6)
    free = Problem(WEIGHTS, np.array([1.4, -0.2]), np.empty((0, 2)), np.empty(0))
    np.testing.assert_allclose(make_solver(name)(free), [1.0, -0.2], atol=1e-6)


def test_a_solver_that_breaks_down_or_lies_has_no_solution():
    problem = Problem(WEIGHTS, np.zeros(2), np.array([[-1.0, -0.5]]), np.array([-0.4]))

    def breaks(problem):
        raise SolverError(problem, "broken")

    assert solve(breaks, problem) is None
    assert solve(lambda problem: np.zeros(2), problem) is None  # breaks the row
    assert solve(lambda problem: np.full(2, np.nan), problem) is None
    np.testing.assert_allclose(solve(planar, problem), [0.2, 0.4])


def test_each_thread_has_workspaces_of_its_own():
    solver, found = KeptOSQP(), []
    threads = [threading.Thread(target=lambda: found.append(solver._workspace(8, WEIGHTS))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({id(workspace) for workspace in found}) == 3
    assert solver._workspace(8, WEIGHTS) is solver._workspace(8, WEIGHTS)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["daqp", "quadprog", "osqp"])
def test_no_solver_warns(name):
    make_solver(name)(Problem(WEIGHTS, np.zeros(2), np.array([[-1.0, -0.5]]), np.array([-0.4])))


@settings(deadline=None, max_examples=200)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_point_of_a_grid_is_better(seed):
    problem = random_problem(np.random.default_rng(seed))
    x = planar(problem)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81)), axis=-1).reshape(-1, 2)
    met = (grid @ problem.G.T <= problem.h).all(axis=1)
    if x is None:
        assert not met.any()
        return
    assert problem.residual(x) <= 1e-9
    better = (
        0.5 * ((grid[met] - problem.reference) ** 2 @ problem.weights)
        < 0.5 * ((x - problem.reference) ** 2 @ problem.weights) - 1e-9
    )
    assert not better.any()


def test_unknown_solver_is_refused():
    with pytest.raises(ValueError, match="no QP solver 'nope'"):
        BarrierFilter(FilterConfig(solver="nope"))
