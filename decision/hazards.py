"""The hazards that are given for one robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def hazards_of_one(hazards: ArrayLike) -> NDArray[np.float64]:
    """Hazards (1, n, 2) [m] from (n, 2) or nothing; no other shape is guessed at, and none is left out.

    Raises:
        ValueError: if they are not such, or not finite.
    """
    given = np.array(hazards, dtype=np.float64)
    if given.shape == (0,):
        return given.reshape(1, 0, 2)
    if given.ndim != 2 or given.shape[1] != 2:
        raise ValueError(f"hazards must have shape [n, 2], got {list(given.shape)}")
    if not np.isfinite(given).all():
        raise ValueError(f"hazards must be finite, got {given[~np.isfinite(given).all(axis=1)][0].tolist()}")
    return given[None]
