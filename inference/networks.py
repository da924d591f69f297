"""The two networks of a bundle, run by onnxruntime as one graph."""

from __future__ import annotations

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from inference.errors import NetworkError
from models import Bundle, BundleError
from system.compiled import entry

FloatArray = NDArray[np.float64]
_ROUNDING = 1e-6


class Networks:
    """Policy and multiplier network of one bundle.

    One intra-op thread without spinning: for networks this small a pool costs more than it computes, and
    spinning takes the core that the robot's other software needs. What both compute is computed once.

    Args:
        bundle: a checked bundle.

    Raises:
        NetworkError: if onnxruntime refuses a graph.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self.observation_size = bundle.manifest.observation_size
        try:
            self._sessions = [session("joined", bundle.joined())]
        except (BundleError, NetworkError):  # each by itself: it runs, or is named
            self._sessions = [session("policy", bundle.policy), session("multiplier", bundle.multiplier)]

    def __reduce__(self) -> tuple[type[Networks], tuple[Bundle]]:
        return Networks, (self._bundle,)

    def run(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nominal action and the risk score; either may be NaN or Inf, and the caller decides what then.

        Args:
            observation: [N, O], numbers that float32 can hold.

        Returns:
            nominal action [N, 2] and risk score λ_ξ(s) [N] (paper eq. 14).
        """
        feed = {"observation": observation.astype(np.float32)}
        action, risk = [output for session in self._sessions for output in session.run(None, feed)]
        return action.astype(np.float64), risk.astype(np.float64)


def session(name: str, graph: bytes) -> onnxruntime.InferenceSession:
    """A graph, ready to run; NetworkError if onnxruntime refuses it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise NetworkError(f"{name}.onnx: onnxruntime refuses it: {' '.join(str(error).split())}") from error


@entry
def within(
    action: FloatArray, low: FloatArray, high: FloatArray, risk: FloatArray, sound: NDArray[np.bool_]
) -> bool:
    """Which of N actions and scores are numbers within their bounds; whether all are.

    Such an ``action`` (N, a) has float32's rounding clipped off, in place: a tanh can reach 1.0000001. A
    ``risk`` (N,) is one from 0 on; ``sound`` (N,) receives which are.
    """
    for k in range(len(action)):
        sound[k] = 0.0 <= risk[k] < np.inf
        for i in range(action.shape[1]):
            sound[k] &= low[i] - _ROUNDING <= action[k, i] <= high[i] + _ROUNDING
        for i in range(action.shape[1]):
            if sound[k]:
                action[k, i] = min(max(action[k, i], low[i]), high[i])
    return bool(sound.all())
