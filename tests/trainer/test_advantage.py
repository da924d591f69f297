import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.advantage import gae, successor_values


def by_definition(signal, values, successors, ended, discount, smoothing):
    """A_t = Σ (γλ)^k δ_{t+k}, summed forwards within each episode."""
    T, N = signal.shape
    out = np.zeros((T, N))
    for n in range(N):
        for t in range(T):
            weight = 1.0
            for k in range(t, T):
                out[t, n] += weight * (signal[k, n] + discount * successors[k, n] - values[k, n])
                if ended[k, n]:
                    break
                weight *= discount * smoothing
    return out


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 1), st.floats(0, 1))
def test_gae_is_its_definition(seed, discount, smoothing):
    rng = np.random.default_rng(seed)
    T, N = 12, 3
    signal, values = rng.normal(size=(T, N)), rng.normal(size=(T + 1, N))
    ended = rng.random((T, N)) < 0.2
    terminated = ended & (rng.random((T, N)) < 0.5)
    final = rng.normal(size=ended.sum())
    after = successor_values(
        *(x.astype(np.float32) if x.dtype == float else x for x in (values, ended, terminated, final))
    )
    got = gae(signal.astype(np.float32), values.astype(np.float32), after, ended, discount, smoothing)
    want = by_definition(signal, values, after, ended, discount, smoothing)
    np.testing.assert_allclose(got, want, atol=1e-4)


def test_time_limits_bootstrap_and_terminations_do_not():
    values = np.array([[1.0], [2.0], [3.0]], np.float32)
    ended = np.array([[True], [True]])
    terminated = np.array([[False], [True]])
    after = successor_values(values, ended, terminated, np.array([7.0, 9.0], np.float32))
    np.testing.assert_array_equal(after, [[7.0], [0.0]])


def test_with_lambda_one_the_target_is_the_discounted_sum():
    signal = np.ones((5, 1), np.float32)
    values = np.full((6, 1), 4.0, np.float32)
    ended = np.zeros((5, 1), bool)
    advantage = gae(signal, values, values[1:], ended, 0.9, 1.0)
    want = sum(0.9**k for k in range(5)) + 0.9**5 * 4.0
    np.testing.assert_allclose(advantage[0] + values[0], want, rtol=1e-6)
