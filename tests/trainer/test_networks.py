import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from trainer import networks
from trainer.networks import Shape, fast_mlp, initial, mlp

SHAPE = Shape(7, 3)


@pytest.fixture
def theta():
    return initial(SHAPE, np.random.default_rng(0), 1.0).double().requires_grad_()


def test_fast_network_has_the_plain_ones_values_and_gradient(theta):
    x = torch.randn(40, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 3
    weight = torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    plain, fast = mlp(theta, x, SHAPE), fast_mlp(theta, x, SHAPE)
    torch.testing.assert_close(fast, plain, atol=1e-12, rtol=0)
    for loss in (lambda y: (weight * y).sum(), lambda y: y.square().mean()):
        (a,) = torch.autograd.grad(loss(mlp(theta, x, SHAPE)), theta)
        (b,) = torch.autograd.grad(loss(fast_mlp(theta, x, SHAPE)), theta)
        torch.testing.assert_close(b, a, atol=1e-12, rtol=1e-10)


def test_a_large_input_saturates_without_nan(theta):
    x = torch.full((2, 7), 1e6, dtype=torch.float64)
    torch.testing.assert_close(fast_mlp(theta, x, SHAPE), mlp(theta, x, SHAPE))


def test_initial_weights_are_orthogonal():
    theta = initial(SHAPE, np.random.default_rng(0), 0.01)
    w1, b1, w2, _, w3, _ = torch.split(theta, SHAPE.splits)
    w1, w2, w3 = w1.view(7, 64).double(), w2.view(64, 64).double(), w3.view(64, 3).double()
    for product, gain in ((w1 @ w1.T, 2.0), (w2 @ w2.T, 2.0), (w3.T @ w3, 1e-4)):
        want = gain * torch.eye(len(product), dtype=torch.float64)
        torch.testing.assert_close(product, want, atol=1e-5 * gain, rtol=0)
    assert (b1 == 0).all()


def test_log_probability_and_divergence_agree_with_torch_distributions():
    g = torch.Generator().manual_seed(0)
    mean, other, action = (torch.randn(9, 2, generator=g) for _ in range(3))
    log_std, other_std = torch.tensor([-0.3, 0.4]), torch.tensor([0.1, -0.2])
    p = Independent(Normal(mean, log_std.exp()), 1)
    q = Independent(Normal(other, other_std.exp()), 1)
    torch.testing.assert_close(networks.log_probability(mean, log_std, action), p.log_prob(action))
    got = networks.kl_divergence(mean, log_std, other, other_std)
    torch.testing.assert_close(got, kl_divergence(p, q).mean())
