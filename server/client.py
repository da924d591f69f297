"""The robot's side of the service: it always has an action, whatever happens to the other side."""

from __future__ import annotations

import http.client
import math
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError
from pydantic_core import to_json

from server.link import Link
from server.schema import ActReply, MemoryJson, ModelReply

DEFAULT_TIMEOUT = 0.5
"""How long a robot waits for its action [s]."""
_CONNECT_TIMEOUT = 5.0


class ClientError(RuntimeError):
    """The service cannot be used: not there, not ours, or of another observation layout."""


class Client:
    """One robot's connection to the service.

    `act` never raises on what the service or the network does: it answers zero thrust, mode "fallback" and
    the reason. The filter's memory of this robot is kept here and sent along; `reset` forgets it.

    Args:
        url: the service, for example "http://127.0.0.1:8000".
        observation_layout: what this robot sends, as `pointgoal.observation.layout(level).to_json()`;
            compared with the service's before the robot moves. None compares each observation's length alone.
        timeout: how long `act` may take, whatever the service sends meanwhile [s]. Looking up a host name is
            not included: give an address where that matters.
        api_key: sent as `Authorization: Bearer`.

    Raises:
        ClientError: if the service does not answer, or its observation layout is another.
        ValueError: if the timeout is not finite and positive, or the key is not printable ASCII.
    """

    def __init__(
        self,
        url: str,
        observation_layout: Sequence[Mapping[str, Any]] | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        api_key: str | None = None,
    ) -> None:
        if not (math.isfinite(timeout) and timeout > 0.0):
            raise ValueError(f"timeout must be finite and positive, got {timeout}")
        try:
            address = urlsplit(url)
            host, port = address.hostname, address.port or 80
        except ValueError as error:
            raise ClientError(f"{url}: {error}") from error
        if address.scheme != "http" or not host or address.path not in ("", "/"):
            raise ClientError(f"{url}: expected http://HOST:PORT")
        headers = {"content-type": "application/json"}
        if api_key is not None:
            if not (api_key.isascii() and api_key.isprintable()):
                raise ValueError("the API key must be printable ASCII")
            headers["authorization"] = f"Bearer {api_key}"
        self._timeout = timeout
        self._memory: MemoryJson | None = None
        self._link = Link(host, port, headers)
        try:
            self._model = self._check(url, observation_layout)
        except ClientError:
            self._link.close()
            raise

    def model(self) -> ModelReply:
        """What the service said about itself at connect."""
        return self._model

    def act(self, observation: ArrayLike, hazards: ArrayLike | None = None) -> ActReply:
        """Asks for the action.

        Args:
            observation: [O], in the service's layout.
            hazards: [n, 2], centres in the body frame [m]; None lets the service decode the lidar.

        Returns:
            The service's reply, or the safe action with mode "fallback" and the reason.
        """
        started = time.perf_counter()
        try:
            body = self._body(observation, hazards)
        except (TypeError, ValueError, OverflowError) as error:
            return self._safe(f"cannot be sent: {error}", started)
        try:
            status, content = self._link.exchange("POST", "/act", body, self._timeout)
            if status != http.client.OK:
                return self._safe(
                    f"the service answered {status}: {content[:200].decode(errors='replace')}", started
                )
            reply = ActReply.model_validate_json(content)
        except TimeoutError:
            return self._safe(f"no reply within {self._timeout} s", started)
        except (OSError, http.client.HTTPException) as error:
            return self._safe(f"connection: {str(error) or type(error).__name__}", started)
        except ValidationError as error:
            return self._safe(f"the reply is not one: {error.errors()[0]['msg']}", started)
        self._memory = reply.memory
        return reply

    def reset(self) -> None:
        """Forgets the filter's memory of this robot: call it when the robot is put elsewhere."""
        self._memory = None

    def close(self) -> None:
        """Closes the connection."""
        self._link.close()

    def __enter__(self) -> Self:
        """The client itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the connection."""
        self.close()

    def _check(self, url: str, layout: Sequence[Mapping[str, Any]] | None) -> ModelReply:
        try:
            status, content = self._link.exchange("GET", "/model", b"", _CONNECT_TIMEOUT)
            if status != http.client.OK:
                raise ClientError(
                    f"{url}: /model answered {status}: {content[:200].decode(errors='replace')}"
                )
            model = ModelReply.model_validate_json(content)
        except (OSError, UnicodeError, http.client.HTTPException) as error:
            raise ClientError(f"{url}: {str(error) or type(error).__name__}") from error
        except ValidationError as error:
            raise ClientError(f"{url}: its /model is not that of a lagnet service") from error
        served = [block.model_dump() for block in model.observation_layout]
        if layout is not None and served != [dict(block) for block in layout]:
            raise ClientError(
                f"{url}: {model.model} wants another observation layout than this robot has: {served}"
            )
        return model

    def _body(self, observation: ArrayLike, hazards: ArrayLike | None) -> bytes:
        body: dict[str, Any] = {"observation": _numbers("observation", observation)}
        if hazards is not None:
            body["hazards"] = _numbers("hazards", hazards)
        if self._memory is not None:
            body["memory"] = self._memory
        return to_json(body)

    def _safe(self, reason: str, started: float) -> ActReply:
        # What the filter planned was for another action than the one that the robot now takes.
        self._memory = None
        return ActReply.safe(reason, time.perf_counter() - started)


def _numbers(name: str, values: ArrayLike) -> list[Any]:
    array = np.asarray(values, dtype=np.float64)
    # The serialiser would send NaN and Inf as null.
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    numbers: list[Any] = array.tolist()
    return numbers
