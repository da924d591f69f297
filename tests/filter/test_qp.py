"""The QP as it is built; the solvers have a file of their own."""

import numpy as np
import pytest

from decision import Mode, Origin
from filter import BarrierFilter, FilterConfig
from filter.config import settings as make_settings
from filter.qp import Problem, asked
from filter.solvers import planar

WEIGHTS = np.array([4.0, 1.0])


def refused(robot_filter, hand):
    """The farthest of some hazards ahead that a robot under full thrust at 0.8 m/s is refused for.

    Returns the decision, the QP and the hazard.
    """
    nominal = np.array([1.0, 0.0])
    for distance in np.arange(0.36, 0.26, -0.002):
        hazard = np.array([[distance, 0.03]])
        observation = hand.observe(hazard, (0.8, 0.0))
        problem = robot_filter.problem(observation, nominal, hazard)
        if problem is not None:
            return robot_filter.filter(observation[None], nominal[None], hazard[None])[0], problem, hazard
    raise AssertionError("nothing is refused")


def test_rows_are_built_only_where_they_are_needed(robot_filter, hand):
    # At rest far enough from the hazard nothing binds: the QP is not even built.
    far = np.array([[1.4, 0.0]])
    assert robot_filter.problem(hand.observe(far), np.array([1.0, 0.0]), far) is None
    # Driving at it, rows bind, and name less thrust.
    _, problem, _ = refused(BarrierFilter(FilterConfig(circulation=0.0)), hand)
    assert problem.reference.tolist() == [1.0, 0.0]
    assert problem.weights.tolist() == [4.0, 1.0]
    assert planar(problem) is not None
    assert planar(problem)[0] < 1.0


def test_from_where_nothing_is_certified_the_row_along_the_obstacle_has_no_solution(robot_filter, hand):
    # 6 cm from the edge at 0.8 m/s: nothing stops there any more.
    near = np.array([[0.26, 0.03]])
    observation, nominal = hand.observe(near, (0.8, 0.0)), np.array([1.0, 0.0])
    assert planar(robot_filter.problem(observation, nominal, near)) is None
    decided = robot_filter.filter(observation[None], nominal[None], near[None])
    assert decided.mode.tolist() == [Mode.FALLBACK]
    assert decided.origin.tolist() == [Origin.HARM]


def test_the_qps_solution_is_what_is_sent(hand):
    for circulation, origin in ((0.7, Origin.CIRCULATION), (0.0, Origin.BARRIER)):
        robot_filter = BarrierFilter(FilterConfig(circulation=circulation))
        decision, problem, _ = refused(robot_filter, hand)
        assert decision.origin == origin
        # The first QP's solution, which is certified at once.
        np.testing.assert_allclose(decision.action, planar(problem) * (0.05, 1.0), atol=1e-12)
        assert problem.G.shape[0] == (2 if circulation else 1)


def test_a_row_asks_for_a_share_of_what_is_there_and_never_for_more_than_there_is():
    numbers = make_settings(FilterConfig(rate=0.25, keep_off=0.005))[0]
    assert asked(numbers, 0.105) == pytest.approx(0.08)
    assert asked(numbers, 0.003) == 0.003
    assert asked(numbers, -0.02) == -0.02


def test_residual_is_found():
    problem = Problem(WEIGHTS, np.zeros(2), np.array([[3.0, 4.0]]), np.array([1.0]))
    assert problem.residual(np.array([1.0, 1.0])) == pytest.approx(6.0 / 5.0)
    assert problem.residual(np.array([0.0, 1.5])) == pytest.approx(1.0)
    assert problem.residual(np.zeros(2)) == 0.0
