"""The robot's side of the service: it always has an action, whatever happens to the other side."""

from __future__ import annotations

import http.client
import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from pydantic_core import to_json

from decision import (
    MEMORY,
    SAFE_ACTION,
    Decision,
    Faults,
    Memory,
    Mode,
    fall_back,
    memory_of,
    memory_to_json,
)
from server.link import Link
from server.schema import ActReply, ModelReply, decision_of

FloatArray = NDArray[np.float64]

DEFAULT_TIMEOUT = 0.02
"""How long a robot waits for its action [s]: one control step, for which a certified action may last."""
_CONNECT_TIMEOUT = 5.0
_EXCERPT = 200
"""Most characters of a reason that come from elsewhere."""


class ClientError(RuntimeError):
    """The service cannot be used: not there, not ours, or of another observation layout."""


class ReplyError(ValueError):
    """A reply that is none to this robot's request."""


class Client:
    """One robot's connection to the service, with the `decide` of `monitor.Monitor`.

    `decide` raises nothing that comes from the service, the network or its arguments. Where it gets no good
    reply it decides by itself: the plan in the robot's memory goes on for as long as it lasts, then the robot
    coasts. It keeps nothing of the robot between calls.

    Args:
        url: the service, for example "http://127.0.0.1:8000".
        observation_layout: what this robot sends, as `pointgoal.observation.layout(level).to_json()`;
            compared with the service's before the robot moves. None compares each observation's length alone.
        timeout: how long `decide` may take, whatever the service sends meanwhile [s]; by default a control
            step of 20 ms. A service that is far away or still warming up takes longer: its late replies are
            so many fallbacks. Connecting here may take 5 s; the host's name is looked up here, once.
        api_key: sent as `Authorization: Bearer`.

    Attributes:
        faults: what went wrong so far.

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
        self.faults = Faults("lagnet.client")
        self._timeout = timeout
        self._request = 0
        self._link = Link(host, port, headers)
        try:
            self._model = self._check(url, observation_layout)
        except ClientError:
            self._link.close()
            raise
        self._low = np.array(self._model.action_low)
        self._high = np.array(self._model.action_high)
        self._safe = np.clip(np.array(SAFE_ACTION), self._low, self._high)

    def model(self) -> ModelReply:
        """What the service said about itself at connect."""
        return self._model

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """Asks the service to decide.

        Args:
            observation: (O,), in the service's layout.
            hazards: (n, 2), centres in the body frame [m]; None or none at all: what the lidar shows.
            memory: the `memory` of this robot's last decision, the client's own included; None before its
                first.

        Returns:
            The service's decision. Where there is none: mode "fallback", origin "plan", opened by "fault",
            and the reason.
        """
        past, kind = np.zeros(1, MEMORY), "bad input"
        try:
            if memory is not None:
                past = self._one_robots(memory)
            self._request += 1
            body = self._body(observation, hazards, None if memory is None else past)
            kind = "service"
            return self._ask(body, self._request)
        except Exception as error:  # noqa: BLE001 - whatever it is, the robot needs an action
            reason = self._note(kind, error)
        return fall_back(past, reason, self._model.threshold, self._safe)[0]

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
                raise ClientError(f"{url}: /model answered {status}: {_excerpt(content)}")
            model = ModelReply.model_validate_json(content)
            _check_model(model)
        except ValidationError as error:
            raise ClientError(f"{url}: its /model is not that of a lagnet service") from error
        except ClientError:
            raise
        except Exception as error:  # whatever it is, the caller was promised a ClientError
            raise ClientError(f"{url}: {_excerpt(str(error) or type(error).__name__)}") from error
        served = [block.model_dump() for block in model.observation_layout]
        if layout is not None and served != [dict(block) for block in layout]:
            raise ClientError(
                f"{url}: {model.model} wants another observation layout than this robot has: {served}"
            )
        return model

    def _one_robots(self, memory: Memory | np.void) -> Memory:
        one = memory_of(1, memory).copy()
        # It may be all that the robot has to go by.
        plan = one["plan"][0, : one["left"][0]]
        if not ((plan >= self._low) & (plan <= self._high)).all():
            raise ValueError("the memory's plan has an action that is none")
        return one

    def _body(self, observation: ArrayLike, hazards: ArrayLike | None, memory: Memory | None) -> bytes:
        numbers = _numbers("observation", observation)
        size = self._model.observation_size
        if numbers.shape != (size,):
            raise ValueError(f"observation must have {size} numbers, got shape {list(numbers.shape)}")
        body: dict[str, Any] = {"request": self._request, "observation": numbers.tolist()}
        if hazards is not None:
            body["hazards"] = _numbers("hazards", hazards).tolist()
        if memory is not None:
            body["memory"] = memory_to_json(memory[0])
        return to_json(body)

    def _ask(self, body: bytes, request: int) -> Decision:
        try:
            status, content = self._link.exchange("POST", "/act", body, self._timeout)
            if status != http.client.OK:
                raise ReplyError(f"the service answered {status}: {_excerpt(content)}")
            reply = ActReply.model_validate_json(content)
            model = self._model
            for name, told, expected in (
                ("request", reply.request, request),
                ("model", reply.model, model.model),
                ("gate", reply.gate, model.gate),
            ):
                if told != expected:
                    raise ReplyError(f"the reply is of {name} {told}, not {expected}")
            decision = decision_of(reply)
            if reply.gate_open != decision.gate_open:
                raise ReplyError("the reply says both that its gate is open and that it is not")
            return self._checked(decision)
        except BaseException:
            # Whoever sends one wrong reply may have others under way.
            self._link.close()
            raise

    def _checked(self, decision: Decision) -> Decision:
        if decision.threshold != self._model.threshold:
            raise ReplyError(f"the reply is of threshold {decision.threshold}, not {self._model.threshold}")
        for what, actions in (("an action", decision.action), ("a plan", decision.plan)):
            if not ((actions >= self._low) & (actions <= self._high)).all():
                raise ReplyError(f"the reply has {what} out of bounds")
        if decision.mode is Mode.NOMINAL and (decision.action != decision.nominal_action).any():
            raise ReplyError("the reply has another action than the nominal one and calls it nominal")
        if decision.mode is Mode.NOMINAL and decision.origin is not None:
            raise ReplyError(f"the reply is nominal and its action comes from the {decision.origin}")
        return decision

    def _note(self, kind: str, error: Exception) -> str:
        """Counts and logs what was caught; the reason for the decision."""
        said = _excerpt(str(error) or type(error).__name__)
        known = True
        if kind == "bad input":
            reason = f"bad input: {said}"
        elif isinstance(error, TimeoutError):
            kind, reason = "time-out", f"no reply within {self._timeout} s"
        elif isinstance(error, OSError | http.client.HTTPException):
            kind, reason = "connection", f"connection: {said}"
        elif isinstance(error, ValidationError):
            kind, reason = "bad reply", f"the reply is not one: {_excerpt(error.errors()[0]['msg'])}"
        elif isinstance(error, ValueError):
            kind, reason = "bad reply", said
        else:
            known, kind, reason = False, type(error).__name__, f"{type(error).__name__}: {said}"
        self.faults.note(kind, reason, None if known else error)
        return reason


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    # The serialiser would send NaN and Inf as null.
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    return array


def _check_model(model: ModelReply) -> None:
    """Raises ClientError for a service that no robot should follow, though its words are in order."""
    low, high = model.action_low, model.action_high
    if not all(-1.0 <= a <= 0.0 <= b <= 1.0 and a < b for a, b in zip(low, high, strict=True)):
        raise ClientError(
            f"{model.model} has actions from {low} to {high}: expected bounds in -1..1 around 0"
        )
    told = sum(block.size for block in model.observation_layout)
    if told != model.observation_size:
        raise ClientError(f"{model.model} wants {model.observation_size} numbers, and its layout has {told}")


def _excerpt(text: str | bytes) -> str:
    """The beginning of a text from elsewhere, on one line: it goes into logs and terminals."""
    beginning = (text[: 4 * _EXCERPT].decode(errors="replace") if isinstance(text, bytes) else text)[
        :_EXCERPT
    ]
    return "".join(letter if letter.isprintable() else "?" for letter in beginning)
