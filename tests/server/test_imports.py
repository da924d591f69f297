"""A robot that only asks a service needs nothing of what the service needs."""

from __future__ import annotations

import subprocess
import sys

from pydantic_core import to_json

from decision import pack
from server.schema import reply_of

SCRIPT = """
import sys
heavy = (
    "torch", "mujoco", "gymnasium", "scipy", "onnx", "onnxruntime", "numba", "osqp", "qpsolvers", "fastapi",
    "starlette", "uvicorn", "tyro", "rich", "monitor", "inference", "models", "filter", "guide", "system",
    "pointgoal", "websockets", "msgpack", "httpx", "prometheus_client",
)
for name in heavy:
    sys.modules[name] = None  # an import of it now raises ImportError
import server
observation = [0.25] * 60
with server.Client(sys.argv[1], timeout=5.0) as client:
    decision = client.decide(observation)
    assert decision.reason is None, decision.reason
    assert client.decide(observation[1:], memory=decision.memory).mode == "fallback"
with server.Fleet(sys.argv[1], timeout=5.0) as fleet:
    decisions = fleet.decide_batch([observation] * 3, memory=None)
    assert decisions.reason == [None] * 3
"""


def test_the_clients_need_numpy_and_pydantic_alone(fake, http, monitor) -> None:
    decision = monitor.decide([0.25] * 60)

    def act(connection, asked) -> None:
        number = int(asked.partition(b'"request":')[2].partition(b",")[0])
        memory = pack(decision.memory.tobytes())
        connection.sendall(
            http(to_json(reply_of(decision, memory, number, monitor.bundle.id, "always", 0.001)))
        )

    with fake(monitor, act) as url:
        result = subprocess.run(
            [sys.executable, "-c", SCRIPT, url], capture_output=True, text=True, timeout=60, check=False
        )
    assert result.returncode == 0, result.stderr
