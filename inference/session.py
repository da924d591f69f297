"""A graph in onnxruntime."""

from __future__ import annotations

import onnxruntime

from inference.errors import NetworkError


def session(name: str, graph: bytes) -> onnxruntime.InferenceSession:
    """A graph, ready to run; NetworkError if onnxruntime refuses it.

    One intra-op thread without spinning: for networks this small a pool costs more than it computes, and
    spinning takes the core that the robot's other software needs.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise NetworkError(f"{name}.onnx: onnxruntime refuses it: {' '.join(str(error).split())}") from error
