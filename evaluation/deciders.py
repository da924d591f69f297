"""Who decides in the closed loop: a monitor in this process, or a service through its client."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from filter import FilterMemory, Mode
from monitor import Monitor
from server import ActReply, Client, ModelReply

FloatArray = NDArray[np.float64]

_MODES = {"nominal": Mode.NOMINAL, "filtered": Mode.FILTERED, "fallback": Mode.FALLBACK}
_SENDERS = 2
"""Threads that send requests: while one waits for the service, the other builds its next request."""


@dataclass(frozen=True)
class Decided:
    """N decisions of one step.

    Attributes:
        action: [N, 2], what to send.
        risk: [N], NaN where unknown.
        mode: [N], of `filter.Mode`.
        barrier: [N] in [m], NaN where unknown.
        reason: N reasons or None.
    """

    action: FloatArray
    risk: FloatArray
    mode: NDArray[np.int8]
    barrier: FloatArray
    reason: list[str | None]


class Decider(Protocol):
    """Decides for the robots of a closed loop, each in its own row."""

    def start(self, count: int) -> None:
        """Gets ready for new episodes of some robots."""

    def decide(self, observation: FloatArray, hazards: FloatArray | None) -> Decided:
        """Decides for observation [N, O], hazards [N, n, 2] in the body frame [m] or None for lidar alone."""

    def seconds(self, observation: FloatArray, hazards: FloatArray | None) -> list[float]:
        """How long decisions take for one robot [s]; the arguments are states it was in."""


class InProcess:
    """Decides by a monitor in this process, for all robots at once."""

    def __init__(self, monitor: Monitor) -> None:
        self._monitor = monitor
        self._memory: FilterMemory | None = None

    def start(self, count: int) -> None:
        """Forgets the robots of the episodes before."""
        self._memory = None

    def decide(self, observation: FloatArray, hazards: FloatArray | None) -> Decided:
        """Decides by `Monitor.decide_batch`."""
        batch = self._monitor.decide_batch(observation, hazards, self._memory)
        self._memory = batch.memory
        return Decided(batch.action, batch.risk, batch.mode, batch.barrier, batch.reason)

    def seconds(self, observation: FloatArray, hazards: FloatArray | None) -> list[float]:
        """Times `Monitor.decide`, one state after the other."""
        result = []
        for i in range(len(observation)):
            given = None if hazards is None else hazards[i]
            started = time.perf_counter()
            self._monitor.decide(observation[i], given)
            result.append(time.perf_counter() - started)
        return result


class OverHttp:
    """Decides through `POST /act`, one connection a robot; to be used as a context manager.

    Args:
        url: the service.
        observation_layout: what the robots send; compared with the service's.
        timeout: how long a robot waits for its action [s].
        api_key: the service's key, if it asks for one.
    """

    def __init__(
        self,
        url: str,
        observation_layout: Sequence[dict[str, Any]],
        timeout: float,
        api_key: str | None = None,
    ) -> None:
        self._url = url
        self._layout = observation_layout
        self._timeout = timeout
        self._api_key = api_key
        self._clients: list[Client] = []
        self._seconds: list[float] = []
        self._open = ExitStack()
        self._senders = self._open.enter_context(ThreadPoolExecutor(_SENDERS, "robots"))

    def connect(self) -> ModelReply:
        """Connects the first robot and returns what the service says about itself.

        Raises:
            ClientError: if the service cannot be used.
        """
        self.start(1)
        return self._clients[0].model()

    def start(self, count: int) -> None:
        """Connects as many robots as needed, and makes each forget.

        Raises:
            ClientError: if the service cannot be used.
        """
        while len(self._clients) < count:
            client = Client(self._url, self._layout, self._timeout, self._api_key)
            self._clients.append(self._open.enter_context(client))
        for client in self._clients:
            client.reset()

    def decide(self, observation: FloatArray, hazards: FloatArray | None) -> Decided:
        """Asks for every robot's action."""
        count = len(observation)
        shares = [range(k, count, _SENDERS) for k in range(_SENDERS)]
        asked = self._senders.map(lambda share: self._ask(share, observation, hazards), shares)
        replies = sorted((answer for share in asked for answer in share), key=lambda answer: answer[0])
        self._seconds += [seconds for _, _, seconds in replies]
        return Decided(
            action=np.array([reply.action for _, reply, _ in replies]),
            risk=np.array([reply.risk for _, reply, _ in replies], dtype=np.float64),
            mode=np.array([_MODES[reply.mode] for _, reply, _ in replies], dtype=np.int8),
            barrier=np.array([reply.barrier for _, reply, _ in replies], dtype=np.float64),
            reason=[reply.reason for _, reply, _ in replies],
        )

    def seconds(self, observation: FloatArray, hazards: FloatArray | None) -> list[float]:
        """The round trips since the last call, as they were in the loop."""
        result, self._seconds = self._seconds, []
        return result

    def __enter__(self) -> Self:
        """The decider itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the connections."""
        self._open.close()

    def _ask(
        self, robots: range, observation: FloatArray, hazards: FloatArray | None
    ) -> list[tuple[int, ActReply, float]]:
        answers = []
        for i in robots:
            given = None if hazards is None else hazards[i]
            started = time.perf_counter()
            reply = self._clients[i].act(observation[i], given)
            answers.append((i, reply, time.perf_counter() - started))
        return answers
