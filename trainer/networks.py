"""The networks, as pure functions of flat parameter vectors.

All of them are perceptrons with two hidden layers of 64 tanh units. A network's parameters are one vector,
so that an optimiser, a trust region and a checkpoint each handle one tensor; several networks of one shape
are a matrix with a network a row, and are evaluated together.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

HIDDEN = 64


@dataclass(frozen=True)
class Shape:
    """Layer sizes of a perceptron: inputs → 64 → 64 → outputs."""

    inputs: int
    outputs: int

    @property
    def layers(self) -> list[tuple[int, int]]:
        """(inputs, outputs) of each layer."""
        return list(pairwise((self.inputs, HIDDEN, HIDDEN, self.outputs)))

    @property
    def splits(self) -> list[int]:
        """Lengths of w1, b1, w2, b2, w3, b3 in the parameter vector."""
        return [length for rows, columns in self.layers for length in (rows * columns, columns)]

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return sum(self.splits)


def initial(shape: Shape, rng: np.random.Generator, output_gain: float) -> Tensor:
    """Orthogonal weights and zero biases.

    Args:
        shape: the layer sizes.
        rng: where the weights are drawn from.
        output_gain: gain of the last layer; the hidden layers have √2.

    Returns:
        Parameters [P], float32.
    """
    parts: list[np.ndarray] = []
    for (rows, columns), gain in zip(shape.layers, (2**0.5, 2**0.5, output_gain), strict=True):
        square = rng.standard_normal((max(rows, columns), min(rows, columns)))
        q, r = np.linalg.qr(square)
        q = q * np.sign(np.diag(r))
        parts += [(gain * (q if rows >= columns else q.T)).reshape(-1), np.zeros(columns)]
    return torch.from_numpy(np.concatenate(parts).astype(np.float32))


def mlp(theta: Tensor, x: Tensor, shape: Shape) -> Tensor:
    """One network on a batch of inputs.

    Args:
        theta: parameters [P].
        x: inputs [B, n].
        shape: the layer sizes.

    Returns:
        Outputs [B, o].
    """
    w1, b1, w2, b2, w3, b3 = torch.split(theta, shape.splits)
    h = torch.addmm(b1, x, w1.view(-1, HIDDEN)).tanh()
    h = torch.addmm(b2, h, w2.view(HIDDEN, HIDDEN)).tanh()
    return torch.addmm(b3, h, w3.view(HIDDEN, -1))


def stacked(theta: Tensor, x: Tensor, shape: Shape) -> Tensor:
    """K networks of one shape on the same batch of inputs.

    Args:
        theta: parameters [K, P].
        x: inputs [B, n].
        shape: the layer sizes, with one output.

    Returns:
        Outputs [K, B].
    """
    k = theta.shape[0]
    w1, b1, w2, b2, w3, b3 = torch.split(theta, shape.splits, dim=1)
    h = torch.baddbmm(b1.unsqueeze(1), x.expand(k, *x.shape), w1.view(k, -1, HIDDEN)).tanh()
    h = torch.baddbmm(b2.unsqueeze(1), h, w2.view(k, HIDDEN, HIDDEN)).tanh()
    return torch.baddbmm(b3.unsqueeze(1), h, w3.view(k, HIDDEN, -1)).squeeze(-1)


def gaussian(theta: Tensor, x: Tensor, shape: Shape) -> tuple[Tensor, Tensor]:
    """The actor: a Gaussian whose mean is a network of the observation and whose deviation is not.

    Args:
        theta: parameters [P + a]: the network's, then the log standard deviations.
        x: normalised observations [B, n].
        shape: the network's layer sizes; a = shape.outputs.

    Returns:
        Mean [B, a] and log standard deviation [a].
    """
    return mlp(theta[: shape.size], x, shape), theta[shape.size :]


def log_probability(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Log density of a diagonal Gaussian.

    Args:
        mean: [B, a].
        log_std: [a].
        action: [B, a].

    Returns:
        [B].
    """
    z = (action - mean) * (-log_std).exp()
    return -0.5 * z.square().sum(-1) - log_std.sum() - 0.5 * mean.shape[-1] * float(np.log(2 * np.pi))


def kl_divergence(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """KL(p ‖ q) of diagonal Gaussians, averaged over the batch.

    Args:
        mean_p: [B, a].
        log_std_p: [a].
        mean_q: [B, a].
        log_std_q: [a].

    Returns:
        Scalar.
    """
    ratio = (2 * (log_std_p - log_std_q)).exp()
    distance = (mean_p - mean_q).square() * (-2 * log_std_q).exp()
    return 0.5 * ((ratio + distance).mean(0) - 1 - 2 * (log_std_p - log_std_q)).sum()
