"""Generalised advantage estimation with time-limit bootstrapping."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]


def successor_values(
    values: Floats, ended: npt.NDArray[np.bool_], over: npt.NDArray[np.bool_], final_values: Floats
) -> Floats:
    """Value of the state that each step led to, before any reset.

    An episode cut off by its time limit goes on as far as its value is concerned: the successor is the
    final observation. A terminated one is worth nothing more.

    Args:
        values: V(s_t) [T + 1, N].
        ended: whether an episode ended with the step [T, N].
        over: whether nothing more can come after it, a terminal state [T, N].
        final_values: V(final observation), one for each True of `ended` in row-major order [E].

    Returns:
        [T, N].
    """
    successors = values[1:].copy()
    successors[ended] = final_values
    successors[over] = 0.0
    return successors


def gae(
    signal: Floats,
    values: Floats,
    successors: Floats,
    ended: npt.NDArray[np.bool_],
    discount: float,
    smoothing: float,
) -> Floats:
    """Advantages A_t = Σ (γλ)^k δ_{t+k} within an episode, δ_t = r_t + γ V(s_{t+1}) − V(s_t).

    Args:
        signal: reward or cost of each step [T, N].
        values: V(s_t) [T + 1, N].
        successors: V of the state each step led to [T, N], see successor_values.
        ended: whether an episode ended with the step [T, N].
        discount: γ.
        smoothing: λ.

    Returns:
        [T, N]. The regression target of the critic is this plus V(s_t).
    """
    delta = signal + np.float32(discount) * successors - values[:-1]
    keep = np.where(ended, np.float32(0), np.float32(discount * smoothing))
    advantage = np.empty_like(delta)
    running = np.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        running = delta[t] + keep[t] * running
        advantage[t] = running
    return advantage
