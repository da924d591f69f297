"""Running normalisation of observations."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

CLIP = 5.0
"""Normalised observations are clipped to ± this."""
SMALLEST_STD = 1e-2
"""Floor of the standard deviation: sensors that never move (gravity) must not amplify their last bits."""


class Normaliser(nn.Module):
    """Running mean and standard deviation of every observation seen, by Chan's parallel formula.

    The statistics move only between epochs, so that within an epoch the policy that acts is the policy
    that is updated.

    Attributes:
        mean: [n], float64.
        variance: [n], float64.
        count: observations seen.
    """

    center: Tensor
    inverse: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("center", torch.empty(size))
        self.register_buffer("inverse", torch.empty(size))
        self.restore(np.zeros(size), np.ones(size), 0.0)

    def restore(self, mean: npt.NDArray[np.float64], variance: npt.NDArray[np.float64], count: float) -> None:
        """Takes on statistics: mean [n], variance [n] and how many observations they are of."""
        self.mean, self.variance, self.count = mean, variance, count
        std = np.maximum(np.sqrt(variance), SMALLEST_STD)
        self.center.copy_(torch.from_numpy(mean))
        self.inverse.copy_(torch.from_numpy(1.0 / std))

    def update(self, observation: npt.NDArray[np.floating]) -> None:
        """Takes observations [B, n] into the statistics."""
        rows = observation.shape[0]
        mean = observation.mean(0, dtype=np.float64)
        variance = observation.var(0, dtype=np.float64)
        total = self.count + rows
        shift = mean - self.mean
        spread = self.variance * self.count + variance * rows + shift**2 * (self.count * rows / total)
        self.restore(self.mean + shift * (rows / total), spread / total, total)

    def forward(self, observation: Tensor) -> Tensor:
        """Normalises observations [B, n] to within ±5."""
        return ((observation - self.center) * self.inverse).clamp(-CLIP, CLIP)
