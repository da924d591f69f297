import numpy as np
import pytest

from trainer.algorithms.lagnet_foresight import next_scale
from trainer.dual import AdamMultiplier, PidMultiplier


def test_adam_multiplier_follows_adams_formula():
    """As written in Kingma and Ba's algorithm 1, with λ held at 0 or above."""
    dual, value, first, second = AdamMultiplier(0.001, 0.035), 0.001, 0.0, 0.0
    for n, cost in enumerate(np.random.default_rng(0).uniform(0, 4, 60), 1):
        gradient = cost - 2.0
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        step = first / (1 - 0.9**n) / ((second / (1 - 0.999**n)) ** 0.5 + 1e-8)
        value = max(0.0, value + 0.035 * step)
        assert dual.update(cost, 2.0) == pytest.approx(value, abs=1e-12)
        assert dual.value == dual.state()["value"]


def test_pid_under_a_constant_excess_has_its_closed_form():
    """P_n = Δ (1 − aⁿ), I_n = I_0 + n k_i Δ, C_n = J (1 − aⁿ), D_n = C_n − C_{n−10}, C_{k<0} = 0."""
    a, J, d, I0 = 0.95, 3.0, 1.0, 0.001
    pid = PidMultiplier(I0, 0.1, 0.01, 0.01, a, 10)
    smoothed = [J * (1 - a**n) for n in range(31)]
    for n in range(1, 31):
        value = pid.update(J, d)
        rise = max(0.0, smoothed[n] - smoothed[max(0, n - 10)])
        assert value == pytest.approx(0.1 * 2 * (1 - a**n) + I0 + n * 0.01 * 2 + 0.01 * rise, rel=1e-12)


def test_pid_stays_at_zero_below_the_limit_and_recovers_at_once():
    pid = PidMultiplier(0.0, 0.1, 0.01, 0.01, 0.95, 10)
    for _ in range(50):
        assert pid.update(0.0, 2.0) == 0.0
    assert pid.integral == 0.0


@pytest.mark.parametrize(
    "build", [lambda: AdamMultiplier(0.1, 0.035), lambda: PidMultiplier(0.1, 0.1, 0.01, 0.01, 0.9, 3)]
)
def test_state_round_trip(build):
    first, second = build(), build()
    for cost in (1.0, 5.0, 2.0, 0.5, 4.0):
        first.update(cost, 1.5)
    second.load_state(first.state())
    assert [first.update(c, 1.5) for c in (3.0, 0.0, 9.0)] == [second.update(c, 1.5) for c in (3.0, 0.0, 9.0)]


def test_scale_grows_geometrically_at_its_largest_step_and_rests_at_the_limit():
    scale = 10.0
    for _ in range(20):
        scale = next_scale(scale, cost=100.0, target=1.0, gain=0.05, step=0.05)
    assert scale == pytest.approx(10 * np.exp(20 * 0.05))
    assert next_scale(scale, cost=2.0, target=2.0, gain=0.05, step=0.05) == scale
    assert next_scale(scale, cost=1.5, target=2.0, gain=0.04, step=0.05) == pytest.approx(
        scale * np.exp(-0.02)
    )
