import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from trainer.algorithms.cpo import Case, Quadratic, weights
from trainer.algorithms.ipo import log_barrier, omnisafe_penalty


def problem(g, b, H, c, delta):
    x, p = np.linalg.solve(H, g), np.linalg.solve(H, b)
    return Quadratic(g @ x, -g @ p, b @ p, c, delta, bool(b @ b <= 1e-6)), x, p


def draw(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    return rng.normal(size=4), rng.normal(size=4), root @ root.T + 0.5 * np.eye(4)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(-1.2, 1.2))
def test_the_step_is_the_optimum_wherever_the_problem_is_feasible(seed, level):
    g, b, H = draw(seed)
    delta = 0.02
    reach = np.sqrt(2 * delta * (b @ np.linalg.solve(H, b)))  # largest change of bᵀΔ in the trust region
    c = level * reach
    numbers, x, p = problem(g, b, H, c, delta)
    along_x, along_p = weights(numbers)
    step = along_x * x + along_p * p
    assert 0.5 * step @ H @ step <= delta * (1 + 1e-4)
    if numbers.case is Case.RECOVERY:
        np.testing.assert_allclose(b @ step, -reach, rtol=1e-4)  # as far down in cost as the region allows
        return
    assert b @ step + c <= 1e-4 * reach
    found = minimize(
        lambda d: -g @ d, -0.9 * p * (reach / (b @ p)) * max(0.0, level), jac=lambda d: -g, method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda d: delta - 0.5 * d @ H @ d, "jac": lambda d: -H @ d},
            {"type": "ineq", "fun": lambda d: -(b @ d + c), "jac": lambda d: -b},
        ],
        options={"ftol": 1e-12, "maxiter": 300},
    )  # fmt: skip
    if found.success and 0.5 * found.x @ H @ found.x <= delta * 1.0001 and b @ found.x + c <= 1e-6:
        assert g @ step >= g @ found.x - 2e-3 * abs(g @ found.x) - 1e-6


@pytest.mark.parametrize(
    ("b", "c", "case"),
    [
        ([1.0, 0.0], 10.0, Case.RECOVERY),
        ([1.0, 0.0], 0.1, Case.INFEASIBLE),
        ([1.0, 0.0], -0.1, Case.PARTLY),
        ([1.0, 0.0], -10.0, Case.FREE),
        ([1e-5, 0.0], -1e-9, Case.FLAT),
    ],
)
def test_each_case_is_reached_and_gives_a_finite_step(b, c, case):
    g = np.array([1.0, 1.0])
    numbers, x, p = problem(g, np.array(b), np.eye(2), c, 0.02)
    assert numbers.case is case
    step = weights(numbers)[0] * x + weights(numbers)[1] * p
    assert np.isfinite(step).all()
    if case in (Case.FREE, Case.FLAT):  # TRPO's step √(2δ / gᵀH⁻¹g) H⁻¹g
        np.testing.assert_allclose(step, np.sqrt(2 * 0.02 / 2) * g, rtol=1e-6)
    if case is Case.RECOVERY:  # −√(2δ/s) p
        np.testing.assert_allclose(step, -np.sqrt(2 * 0.02) * np.array(b), rtol=1e-6)


def test_at_the_limit_itself_the_step_does_not_raise_the_cost():
    numbers, x, p = problem(np.array([1.0, 1.0]), np.array([1.0, 0.0]), np.eye(2), 0.0, 0.02)
    along_x, along_p = weights(numbers)
    step = along_x * x + along_p * p
    np.testing.assert_allclose(step, [0.0, np.sqrt(0.04)], atol=1e-5)


def test_log_barrier_is_the_paper_inside_and_its_tangent_beyond():
    t = 20.0
    z = torch.linspace(-2, -1 / t**2, 50, dtype=torch.float64)
    for value in z:
        torch.testing.assert_close(log_barrier(value, t), -torch.log(-value) / t)
    edge = torch.tensor(-1 / t**2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(log_barrier(edge - 1e-12, t), edge)
    torch.testing.assert_close(slope, torch.tensor(t, dtype=torch.float64), rtol=1e-6, atol=0)
    beyond = torch.tensor(0.7, dtype=torch.float64)
    want = log_barrier(edge.detach(), t) + t * (beyond + 1 / t**2)
    torch.testing.assert_close(log_barrier(beyond, t), want)


def test_omnisafe_penalty_is_kept_within_zero_and_one():
    assert omnisafe_penalty(1.0, 2.0, 0.01) == pytest.approx(0.01)
    assert omnisafe_penalty(3.0, 2.0, 0.01) == 1.0
    assert omnisafe_penalty(1.999, 2.0, 0.01) == 1.0
