"""Running normalisation of observations."""

import numpy as np
import numpy.typing as npt

CLIP = 5.0
"""Normalised observations are clipped to ± this."""
SMALLEST_STD = 1e-2
"""Floor of the standard deviation: sensors that never move (gravity) must not amplify their last bits."""


class Normaliser:
    """Running mean and standard deviation of every observation seen, by Chan's parallel formula.

    The statistics move only between epochs, so that within an epoch the policy that acts is the policy
    that is updated.

    Attributes:
        mean: [n], float64.
        variance: [n], float64.
        count: observations seen.
    """

    def __init__(self, size: int) -> None:
        self.mean: npt.NDArray[np.float64] = np.zeros(size)
        self.variance: npt.NDArray[np.float64] = np.ones(size)
        self.count = 0.0

    def update(self, observation: npt.NDArray[np.floating]) -> None:
        """Takes observations [B, n] into the statistics."""
        rows = observation.shape[0]
        mean = observation.mean(0, dtype=np.float64)
        variance = observation.var(0, dtype=np.float64)
        total = self.count + rows
        shift = mean - self.mean
        spread = self.variance * self.count + variance * rows + shift**2 * (self.count * rows / total)
        self.mean = self.mean + shift * (rows / total)
        self.variance = spread / total
        self.count = total

    def scale(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Mean [n] and 1 / standard deviation [n] as the graphs and the rollout use them, float32."""
        std = np.maximum(np.sqrt(self.variance), SMALLEST_STD)
        return self.mean.astype(np.float32), (1.0 / std).astype(np.float32)

    def __call__(
        self, observation: npt.NDArray[np.floating], dtype: type = np.float32
    ) -> npt.NDArray[np.float32]:
        """Normalises observations [..., n] to within ±5, computed in the precision of `dtype`."""
        mean, inverse = self.scale()
        z: npt.NDArray[np.float32] = np.subtract(observation, mean, dtype=dtype)
        np.multiply(z, inverse, out=z)
        np.clip(z, -CLIP, CLIP, out=z)
        return z
