"""The two networks of a bundle, run by onnxruntime as one graph."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

from inference.cut import Answer, Cut, compare
from inference.errors import NetworkError
from inference.session import session
from inference.trials import trials
from models import Bundle, BundleError, features
from system.compiled import entry

FloatArray = NDArray[np.float64]
_ROUNDING = 1e-6
_LOGGER = logging.getLogger("lagnet.inference")


class Networks:
    """Policy and multiplier network of one bundle.

    What both compute is computed once. Where the files say what their features are, compiled code computes
    these; but if that, tried on hundreds of observations, does not come to what the graph itself gives, the
    graph computes them, and a warning is logged.

    Args:
        bundle: a checked bundle.

    Raises:
        NetworkError: if onnxruntime refuses a graph.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self.observation_size = bundle.manifest.observation_size
        self._answer: Callable[[FloatArray], Answer]
        try:
            joined = bundle.joined()
            self._answer = _whole(session("joined", joined))
        except (BundleError, NetworkError):  # each by itself: it runs, or is named
            self._answer = _whole(session("policy", bundle.policy), session("multiplier", bundle.multiplier))
            return
        self._answer = self._cut(onnx.load_model_from_string(joined)) or self._answer

    def __reduce__(self) -> tuple[type[Networks], tuple[Bundle]]:
        return Networks, (self._bundle,)

    def run(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nominal action and the risk score; either may be NaN or Inf, and the caller decides what then.

        Args:
            observation: [N, O], numbers that float32 can hold.

        Returns:
            nominal action [N, 2] and risk score λ_ξ(s) [N] (paper eq. 14).
        """
        action, risk = self._answer(observation)
        return action.astype(np.float64), risk.astype(np.float64)

    def _cut(self, joined: onnx.ModelProto) -> Cut | None:
        """The networks from their features on, if the files tell these and it gives what the graph gives."""
        manifest = self._bundle.manifest
        try:
            numbers = features.read(joined)
            if numbers is None:
                files = map(onnx.load_model_from_string, (self._bundle.policy, self._bundle.multiplier))
                if not all(map(features.told, files)):
                    return None
                raise BundleError("what the two files say of them is not understood, or not the same")
            cut = Cut(joined, numbers)
            largest = np.maximum(np.abs(manifest.action_low), np.abs(manifest.action_high))
            tried = trials(numbers)
            for seen in (tried[:1], tried[1:2], tried):
                compare(cut(seen), self._answer(seen), largest)
        except Exception as error:  # noqa: BLE001 - whatever it is, there is the whole graph
            why = " ".join(str(error).split())
            _LOGGER.warning(
                "%s: its graph computes the features, which takes longer: %s", self._bundle.id, why
            )
            return None
        return cut


def _whole(*sessions: onnxruntime.InferenceSession) -> Callable[[FloatArray], Answer]:
    """Of all that the sessions compute, from the observation on."""

    def answer(observation: FloatArray) -> Answer:
        feed = {"observation": observation.astype(np.float32)}
        action, risk = [output for session in sessions for output in session.run(None, feed)]
        return action, risk

    return answer


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
