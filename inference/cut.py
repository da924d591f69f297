"""Both networks from their features on: compiled code computes these, onnxruntime the rest."""

from __future__ import annotations

import threading

import numpy as np
import onnx
import onnxruntime
from numpy.typing import DTypeLike, NDArray

from inference.errors import NetworkError
from inference.features import OBSERVATION, SIZE, Features, FloatArray
from inference.session import session
from models import features
from models.features import FeatureNumbers

Answer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Actions [N, 2] and multipliers [N]."""

_REALS: dict[int, DTypeLike] = {onnx.TensorProto.FLOAT: np.float32, onnx.TensorProto.DOUBLE: np.float64}
_OUTPUTS = ["action", "multiplier"]
_ACTION_TOLERANCE, _RISK_TOLERANCE = 2e-5, 1e-5


class Cut:
    """Both networks from their features on.

    Args:
        model: both as one graph.
        numbers: what it says of its features.

    Raises:
        BundleError: if it has no such features.
        NetworkError: if they are not those of this task, or the networks need more than them.
    """

    def __init__(self, model: onnx.ModelProto, numbers: FeatureNumbers) -> None:
        rest, kind = features.after(model, numbers.tensor)
        if kind not in _REALS or len(numbers.center) != OBSERVATION:
            raise NetworkError(
                f"features of {len(numbers.center)} numbers and data type {kind} are not known"
            )
        self._tensor = numbers.tensor
        self._features = Features(numbers, _REALS[kind])
        self._session = session("from the features on", rest.SerializeToString())
        self._one = _One(self._session, self._tensor, _REALS[kind])

    def __call__(self, observation: FloatArray) -> Answer:
        """What the networks give for observations [N, 60]; one's answer lasts until this thread's next."""
        if len(observation) == 1:
            one = self._one
            self._features(observation, out=one.features)
            self._session.run_with_iobinding(one.binding)
            return one.action, one.risk
        action, risk = self._session.run(_OUTPUTS, {self._tensor: self._features(observation)})
        return action, risk


class _One(threading.local):
    """One robot's features and answer, where onnxruntime finds and leaves them; each thread has its own.

    That takes a third off the time of a call.
    """

    def __init__(self, networks: onnxruntime.InferenceSession, tensor: str, real: DTypeLike) -> None:
        self.features = np.empty((1, SIZE), real)
        self.action = np.empty((1, 2), np.float32)
        self.risk = np.empty(1, np.float32)
        self.binding = networks.io_binding()
        for bind, name, array in (
            (self.binding.bind_input, tensor, self.features),
            (self.binding.bind_output, "action", self.action),
            (self.binding.bind_output, "multiplier", self.risk),
        ):
            bind(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)


def compare(found: Answer, expected: Answer, largest: FloatArray) -> None:
    """Hold what two forms of the same networks give against each other.

    Args:
        found: of the one.
        expected: of the other.
        largest: (2,) the largest actions.

    Raises:
        NetworkError: if an action is off by more than 2e-5 of the largest, a multiplier by more than 1e-5 of
            itself and of 1, or only one of both is a number.
    """
    allowed = _ACTION_TOLERANCE * largest, _RISK_TOLERANCE * (1.0 + np.abs(expected[1]))
    for name, one, other, most in zip(_OUTPUTS, found, expected, allowed, strict=True):
        if one.shape != other.shape:
            raise NetworkError(f"{name} has shape {one.shape}, not {other.shape}")
        numbers, others = np.isfinite(one), np.isfinite(other)
        with np.errstate(invalid="ignore"):
            wrong = np.where(numbers & others, np.abs(one - other) > most, numbers | others)
        if wrong.any():
            rows = np.unique(np.argwhere(wrong)[:, 0])
            raise NetworkError(
                f"the {name} is another on {len(rows)} of {len(one)} observations tried: "
                f"{one[rows[0]].tolist()}, not {other[rows[0]].tolist()}"
            )
