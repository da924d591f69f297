"""Several robots on one service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import MEMORY, Decision, Decisions, Faults, Memory
from server.client import DEFAULT_TIMEOUT, Client
from server.schema import ModelReply
from server.session import MOST_FAILURES

FloatArray = NDArray[np.float64]

_SENDERS = 2
"""Threads that send requests: while one waits for the service, the other builds its next request."""


class Fleet:
    """A client for each of several robots, with the `decide` and `decide_batch` of `monitor.Monitor`.

    Args:
        url: the service, or several, see `Client`.
        observation_layout: what the robots send, see `Client`.
        timeout: how long a robot waits for its action [s].
        api_key: the service's key, if it asks for one.
        most_failures: a robot's failures in a row after which it holds until `resume`; None: never.

    Attributes:
        faults: what went wrong so far, over all robots.

    Raises:
        ClientError: if the service cannot be used.
        ValueError: for a timeout or a key that is none.
    """

    def __init__(
        self,
        url: str | Sequence[str],
        observation_layout: Sequence[Mapping[str, Any]] | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        api_key: str | None = None,
        most_failures: int | None = MOST_FAILURES,
    ) -> None:
        self._service = (url, observation_layout, timeout, api_key, None, most_failures)
        self._clients: list[Client] = []
        self._open = ExitStack()
        self.faults = Faults("lagnet.client")
        self._connect(1)
        self._senders = self._open.enter_context(ThreadPoolExecutor(_SENDERS, "robots"))

    def model(self) -> ModelReply:
        """What the service said about itself at connect."""
        return self._clients[0].model()

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """`Client.decide` of the first robot."""
        return self._clients[0].decide(observation, hazards, memory)

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        """Asks for every robot's decision; robots beyond those of the calls before are connected first.

        Args:
            observation: (N, O), N at least 1.
            hazards: (N, n, 2) in the body frame [m], rows of NaN stand for none; None: the lidar alone.
            memory: the `memory` of these robots' last decisions, or None.

        Raises:
            ValueError: if observation, hazards or memory are not those of N robots.
            ClientError: if a further robot cannot connect.
        """
        rows = np.asarray(observation, dtype=np.float64)
        if rows.ndim != 2 or not len(rows):
            raise ValueError(
                f"observation must have shape [N, {self.model().observation_size}], got {rows.shape}"
            )
        count = len(rows)
        given = None if hazards is None else np.asarray(hazards, dtype=np.float64)
        if given is not None and (given.ndim != 3 or given.shape[::2] != (count, 2)):
            raise ValueError(f"hazards must have shape [{count}, n, 2], got {given.shape}")
        if memory is not None and (memory.dtype != MEMORY or memory.shape != (count,)):
            raise ValueError(f"memory is not that of {count} robots")
        self._connect(count)

        def ask(i: int) -> Decision:
            return _ask(
                self._clients[i],
                rows[i],
                None if given is None else given[i],
                None if memory is None else memory[i],
            )

        decided: list[Decision | None] = [None] * count

        def ask_some(first: int) -> None:
            for i in range(first, count, _SENDERS):
                decided[i] = ask(i)

        list(self._senders.map(ask_some, range(_SENDERS)))
        return Decisions.of([decision for decision in decided if decision is not None])

    def resume(self) -> None:
        """Ends the holds, see `Client.resume`.

        Raises:
            ClientError: if a robot cannot connect.
        """
        for client in self._clients:
            if client.held is not None:
                client.resume()

    def close(self) -> None:
        """Closes the connections."""
        self._open.close()

    def __enter__(self) -> Self:
        """The fleet itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the connections."""
        self.close()

    def _connect(self, count: int) -> None:
        while len(self._clients) < count:
            client = self._open.enter_context(Client(*self._service))
            client.faults = self.faults
            self._clients.append(client)


def _ask(
    client: Client, observation: FloatArray, hazards: FloatArray | None, memory: np.void | None
) -> Decision:
    """`Client.decide` with hazards of which some rows stand for none."""
    if hazards is None:
        return client.decide(observation, None, memory)
    there = np.flatnonzero(~np.isnan(hazards).any(axis=1))
    decision = client.decide(observation, hazards[there], memory)
    if len(there) == len(hazards) or decision.hazard is None:
        return decision
    # The service counts the hazards that it was given, and then the lidar's bins.
    beyond = decision.hazard - len(there)
    return replace(decision, hazard=int(there[decision.hazard]) if beyond < 0 else len(hazards) + beyond)
