"""A robot's side of the service without the network, the same for every client.

What is asked, what of a reply is believed, and what is done without one. Clients differ in how bytes travel.
"""

from __future__ import annotations

import http.client
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from pydantic_core import to_json

from decision import MEMORY, SAFE_ACTION, Decision, Faults, Memory, Mode, fall_back, memory_of, pack
from server.schema import ActReply, ModelReply, decision_of

FloatArray = NDArray[np.float64]

MOST_FAILURES = 25
"""Failures in a row after which a client holds: half a second at 50 Hz, when every plan has ended."""
EXCERPT = 200
"""Most characters of a reason that come from elsewhere."""


class ClientError(RuntimeError):
    """The service cannot be used: not there, not ours, or of another observation layout."""


class StepError(RuntimeError):
    """There was no good reply, and the client was asked to raise.

    Attributes:
        decision: the fallback, to be sent nevertheless.
    """

    def __init__(self, decision: Decision) -> None:
        super().__init__(decision.reason)
        self.decision = decision


class ReplyError(ValueError):
    """A reply that is none to this robot's request."""


class RefusedError(ReplyError):
    """The service has looked at the request and refused it: any other would, too."""


class InputError(ValueError):
    """What the robot itself gave is not in order."""


class HeldError(ValueError):
    """The client holds."""


class Sealed(NamedTuple):
    """A memory as the service sealed it, and what has become of it here."""

    now: bytes
    """The memory that was given out last."""
    text: str
    """The one it was, as it came."""
    played: int
    """For how many control steps the robot has gone on by itself since."""


class Session:
    """One robot's exchanges with a service, or with several that serve the same bundle.

    Args:
        observation_layout: what this robot sends; None compares each observation's length alone.
        robot: the robot's name; None: it has none.
        most_failures: after so many failures in a row it holds; None: never.
        raises: whether a step without a good reply raises.
        clock: stamps requests; None: they have no stamp.

    Attributes:
        faults: what went wrong so far.
        held: why it holds, else None.
        met: what the service said about itself, once it has.

    Raises:
        ValueError: for a number of failures below 1.
    """

    def __init__(
        self,
        observation_layout: Sequence[Mapping[str, Any]] | None = None,
        robot: str | None = None,
        most_failures: int | None = MOST_FAILURES,
        raises: bool = False,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if most_failures is not None and most_failures < 1:
            raise ValueError(f"most_failures must be at least 1, got {most_failures}")
        self.faults = Faults("lagnet.client")
        self.held: str | None = None
        self._layout = observation_layout
        self._robot = robot
        self._most_failures = most_failures
        self._raises = raises
        self._clock = clock
        self.met: ModelReply | None = None
        self._failures = 0
        self._request = 0
        self._past: Memory = np.zeros(1, MEMORY)
        self._sealed = Sealed(b"", "", 0)

    @property
    def model(self) -> ModelReply:
        """What the service said about itself.

        Raises:
            ClientError: if none has.
        """
        if self.met is None:
            raise ClientError("no service has said yet what it runs")
        return self.met

    def meet(self, url: str, status: int, content: bytes) -> None:
        """Compares what a service answers to `GET /model`: the first with the robot, others with the first.

        Raises:
            ClientError: if no robot should follow it, or it is another than it was.
        """
        if status != http.client.OK:
            raise ClientError(f"{url}: /model answered {status}: {excerpt(content)}")
        try:
            model = ModelReply.model_validate_json(content)
        except ValidationError as error:
            raise ClientError(f"{url}: its /model is not that of a lagnet service") from error
        if self.met is not None:
            if model != self.met:
                raise ClientError(f"{url}: {_how_else(self.met, model)}")
            return
        _check_model(url, model)
        served = [block.model_dump() for block in model.observation_layout]
        if self._layout is not None and served != [dict(block) for block in self._layout]:
            raise ClientError(
                f"{url}: {model.model} wants another observation layout than this robot has: {served}"
            )
        self._low, self._high = np.array(model.action_low), np.array(model.action_high)
        self._safe = np.clip(np.array(SAFE_ACTION), self._low, self._high)
        self.met = model

    def ask(
        self, observation: ArrayLike, hazards: ArrayLike | None, memory: Memory | np.void | None
    ) -> bytes:
        """The body of the next request.

        Raises:
            InputError: if what is given is not in order.
            HeldError: if it holds.
        """
        self._past = np.zeros(1, MEMORY)
        try:
            if memory is not None:
                self._past = self._one_robots(memory)
            body = self._body(observation, hazards)
        except Exception as error:  # whatever cannot be made a number
            raise InputError(str(error) or type(error).__name__) from error
        if self.held is not None:
            raise HeldError(self.held)
        return body

    def told(self, status: int, content: bytes) -> Decision:
        """The decision in the reply to the last request.

        Raises:
            ReplyError: if it is not to be believed.
            pydantic.ValidationError: if it is none.
        """
        if status != http.client.OK:
            refused = RefusedError if status == http.client.UNPROCESSABLE_ENTITY else ReplyError
            raise refused(f"the service answered {status}: {excerpt(content)}")
        reply = ActReply.model_validate_json(content)
        model = self.model
        for name, told, expected in (
            ("request", reply.request, self._request),
            ("model", reply.model, model.model),
            ("gate", reply.gate, model.gate),
        ):
            if told != expected:
                raise ReplyError(f"the reply is of {name} {told}, not {expected}")
        decision = decision_of(reply)
        if reply.gate_open != decision.gate_open:
            raise ReplyError("the reply says both that its gate is open and that it is not")
        self._check(decision)
        if decision.plan.tolist() != reply.plan:
            raise ReplyError("the reply has another plan than its memory")
        self._failures = 0
        self._sealed = Sealed(decision.memory.tobytes(), reply.memory, 0)
        return decision

    def failed(self, error: Exception, timeout: float) -> Decision:
        """What the robot does without a good reply: the plan in its memory goes on, then it coasts.

        Args:
            error: what came instead.
            timeout: how long was waited [s].

        Raises:
            StepError: with the decision, if that is asked for.
        """
        reason = self._note(error, timeout)
        self._failures += 1
        if self.held is None and self._most_failures is not None and self._failures >= self._most_failures:
            self.held = f"held after {self._failures} failures in a row until resume(): {reason}"
            self.faults.note("hold", self.held)
        threshold = np.nan if self.met is None else self.met.threshold
        decision = fall_back(self._past, reason, threshold, self._safe)[0]
        text, played = self._as_sealed()
        if text is not None:
            self._sealed = Sealed(decision.memory.tobytes(), text, played + 1)
        if self._raises:
            raise StepError(decision) from error
        return decision

    @contextmanager
    def anew(self) -> Iterator[None]:
        """Within, a service is met as if it were the first; if that succeeds a hold has ended."""
        known, self.met = self.met, None
        try:
            yield
        except BaseException:
            self.met = known
            raise
        self.held, self._failures = None, 0

    def _one_robots(self, memory: Memory | np.void) -> Memory:
        one = memory_of(1, memory).copy()
        # It may be all that the robot has to go by.
        plan = one["plan"][0, : one["left"][0]]
        if not ((plan >= self._low) & (plan <= self._high)).all():
            raise ValueError("the memory's plan has an action that is none")
        return one

    def _body(self, observation: ArrayLike, hazards: ArrayLike | None) -> bytes:
        numbers = _numbers("observation", observation)
        size = self.model.observation_size
        if numbers.shape != (size,):
            raise ValueError(f"observation must have {size} numbers, got shape {list(numbers.shape)}")
        self._request += 1
        body: dict[str, Any] = {"request": self._request, "observation": numbers.tolist()}
        if hazards is not None:
            body["hazards"] = _numbers("hazards", hazards).tolist()
        if self._clock is not None:
            body["stamp"] = float(_numbers("stamp", self._clock()))
        text, played = self._as_sealed()
        if text is not None:
            body["memory"] = text
        if played:
            body["played"] = played
        if self._robot is not None:
            body["robot"] = self._robot
        return to_json(body)

    def _as_sealed(self) -> tuple[str | None, int]:
        """The memory that was given, as the service knows it, and for how many steps it has been played."""
        now = self._past.tobytes()
        if now == self._sealed.now:
            return self._sealed.text, self._sealed.played
        return (pack(now), 0) if self._past["seal"].any() else (None, 0)

    def _check(self, decision: Decision) -> None:
        threshold = self.model.threshold
        if decision.threshold != threshold:
            raise ReplyError(f"the reply is of threshold {decision.threshold}, not {threshold}")
        for what, actions in (("an action", decision.action), ("a plan", decision.plan)):
            if not ((actions >= self._low) & (actions <= self._high)).all():
                raise ReplyError(f"the reply has {what} out of bounds")
        if decision.mode is Mode.NOMINAL and (decision.action != decision.nominal_action).any():
            raise ReplyError("the reply has another action than the nominal one and calls it nominal")
        if decision.mode is Mode.NOMINAL and decision.origin is not None:
            raise ReplyError(f"the reply is nominal and its action comes from the {decision.origin}")

    def _note(self, error: Exception, timeout: float) -> str:
        """Counts and logs what was caught; the reason for the decision."""
        said = excerpt(str(error) or type(error).__name__)
        known = True
        if isinstance(error, InputError):
            kind, reason = "bad input", f"bad input: {said}"
        elif isinstance(error, HeldError):
            kind, reason = "held", said
        elif isinstance(error, TimeoutError):
            kind, reason = "time-out", f"no reply within {timeout} s"
        elif isinstance(error, OSError | http.client.HTTPException):
            kind, reason = "connection", f"connection: {said}"
        elif isinstance(error, ClientError):
            kind, reason = "service", said
        elif isinstance(error, ValidationError):
            kind, reason = "bad reply", f"the reply is not one: {excerpt(error.errors()[0]['msg'])}"
        elif isinstance(error, ValueError):
            kind, reason = "bad reply", said
        else:
            known, kind, reason = False, type(error).__name__, f"{type(error).__name__}: {said}"
        self.faults.note(kind, reason, None if known else error)
        return reason


def excerpt(text: str | bytes) -> str:
    """The beginning of a text from elsewhere, on one line: it goes into logs and terminals."""
    beginning = (text[: 4 * EXCERPT].decode(errors="replace") if isinstance(text, bytes) else text)[:EXCERPT]
    return "".join(letter if letter.isprintable() else "?" for letter in beginning)


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    # The serialiser would send NaN and Inf as null.
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    return array


def _how_else(was: ModelReply, now: ModelReply) -> str:
    """What a service says of itself that another has not said, or the same has not before."""
    names = [name for name in ModelReply.model_fields if getattr(was, name) != getattr(now, name)]
    return f"it runs {now.model}, which is not {was.model} as it was: {', '.join(names)} differ"


def _check_model(url: str, model: ModelReply) -> None:
    """Raises ClientError for a service that no robot should follow, though its words are in order."""
    low, high = model.action_low, model.action_high
    if not all(-1.0 <= a <= 0.0 <= b <= 1.0 and a < b for a, b in zip(low, high, strict=True)):
        raise ClientError(
            f"{url}: {model.model} has actions from {low} to {high}: expected bounds in -1..1 around 0"
        )
    told = sum(block.size for block in model.observation_layout)
    if told != model.observation_size:
        raise ClientError(
            f"{url}: {model.model} wants {model.observation_size} numbers, and its layout has {told}"
        )
