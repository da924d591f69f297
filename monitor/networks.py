"""The two networks of a bundle, run by onnxruntime."""

from __future__ import annotations

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from models import Bundle
from monitor.errors import NetworkError

FloatArray = NDArray[np.float64]

_ORT_FAULTS = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
    RuntimeError,
    ValueError,
)


class Networks:
    """Policy and multiplier network of one bundle.

    One intra-op thread without spinning: for networks this small a thread pool costs more than it computes,
    and its spinning takes the core that the robot's other software needs.

    Args:
        bundle: a checked bundle.

    Raises:
        NetworkError: if onnxruntime refuses a graph.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.observation_size = bundle.manifest.observation_size
        self._policy = _session(bundle.policy, "policy.onnx")
        self._multiplier = _session(bundle.multiplier, "multiplier.onnx")

    def run(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nominal action and the risk score; either may be NaN or Inf, and the caller decides what then.

        Args:
            observation: [N, O], numbers that float32 can hold.

        Returns:
            nominal action [N, 2] and risk score λ_ξ(s) [N] (paper eq. 14).

        Raises:
            NetworkError: if a network fails or gives another shape.
        """
        feed = {"observation": observation.astype(np.float32)}
        try:
            action = self._policy.run(["action"], feed)[0]
            risk = self._multiplier.run(["multiplier"], feed)[0]
        except _ORT_FAULTS as error:
            raise NetworkError(f"onnxruntime: {' '.join(str(error).split())}") from error
        expected = len(observation)
        if action.shape != (expected, 2) or risk.shape != (expected,):
            raise NetworkError(
                f"the networks gave shapes {action.shape} and {risk.shape} for {expected} observations"
            )
        return action.astype(np.float64), risk.astype(np.float64)


def _session(graph: bytes, name: str) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except _ORT_FAULTS as error:
        raise NetworkError(f"{name}: onnxruntime refuses it: {' '.join(str(error).split())}") from error
