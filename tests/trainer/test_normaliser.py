import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.normaliser import SMALLEST_STD, Normaliser


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=5), st.integers(0, 1000), st.floats(-100, 100))
def test_batches_add_up_to_the_whole(sizes, seed, shift):
    rng = np.random.default_rng(seed)
    parts = [rng.normal(shift, 2.0, (n, 4)) for n in sizes]
    normaliser = Normaliser(4)
    for part in parts:
        normaliser.update(part)
    whole = np.concatenate(parts)
    np.testing.assert_allclose(normaliser.mean, whole.mean(0), atol=1e-9)
    np.testing.assert_allclose(normaliser.variance, whole.var(0), atol=1e-8)


def test_a_constant_sensor_does_not_blow_up_its_last_bits():
    normaliser = Normaliser(1)
    normaliser.update(np.full((100, 1), 9.81) + np.linspace(0, 1e-9, 100)[:, None])
    assert abs(normaliser(torch.tensor([[9.81 + 1e-4]], dtype=torch.float64))).max() < 1e-3 / SMALLEST_STD


def test_output_is_clipped():
    normaliser = Normaliser(2)
    normaliser.update(np.random.default_rng(0).normal(size=(50, 2)))
    out = normaliser(torch.tensor([[1e9, -1e9]]))
    assert out.tolist() == [[5.0, -5.0]]
    assert out.dtype == torch.float32
