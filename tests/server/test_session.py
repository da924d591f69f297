"""What every client does, whatever comes: an action always, a hold after failures, and never an old reply."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from pydantic_core import to_json

from decision import MEMORY, Decision, Memory, Mode, OpenedBy, Origin, pack, unpack
from server.schema import Block, ModelReply, reply_of
from server.session import ClientError, Session, StepError

MOST = 4
PLAN = [[-0.05, 0.25], [0.05, -0.5]]


def model(**changes: object) -> ModelReply:
    """What a service says of itself."""
    told: dict[str, object] = {
        "model": "bundle",
        "task": "PointGoal1-v0",
        "level": 1,
        "algorithm": "x",
        "sha256": {},
        "observation_size": 2,
        "observation_layout": [Block(name="sensor", start=0, size=2, unit="1")],
        "action_low": [-1.0, -1.0],
        "action_high": [1.0, 1.0],
        "hazard_radius": 0.2,
        "robot": {},
        "gate": "risk",
        "threshold": 0.5,
        "threshold_source": "x",
        "guide": "off",
    }
    return ModelReply.model_validate(told | changes)


def meet(session: Session, **changes: object) -> None:
    session.meet("http://one", 200, model(**changes).model_dump_json().encode())


def reply(number: int, request: int, **changes: object) -> bytes:
    """A good reply whose memory has the plan and a seal of its own."""
    memory = np.zeros(1, MEMORY)
    memory["planned"], memory["left"], memory["seal"] = True, len(PLAN), number
    memory["plan"][0, : len(PLAN)] = PLAN
    action = np.array([0.01, 0.5])
    decision = Decision(
        action, action, Mode.NOMINAL, None, True, 1.0, None, None, 0.1, 0.5, None, 0.1, None, memory[0]
    )
    return to_json(reply_of(decision, pack(memory.tobytes()), request, "bundle", "risk", 0.001) | changes)


class Sessions(RuleBasedStateMachine):
    """A robot's steps, with replies, failures, holds and resumptions in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.session = Session(most_failures=MOST, robot="one")
        meet(self.session)
        self.memory: Memory | np.void | None = None
        self.text: str | None = None
        self.played = self.failures = self.number = 0
        self.held = False

    def failed(self, error: Exception) -> None:
        left = 0 if self.memory is None else int(self.memory["left"])
        expected = [0.0, 0.0] if not left else self.memory["plan"][0].tolist()
        decision = self.session.failed(error, 0.02)
        self.failures += 1
        self.played += 1
        self.held |= self.failures >= MOST
        assert (decision.mode, decision.origin, decision.opened_by) == (
            Mode.FALLBACK,
            Origin.PLAN,
            OpenedBy.FAULT,
        )
        assert decision.reason
        assert decision.action.tolist() == expected
        assert decision.memory["left"] == max(left - 1, 0)
        self.memory = decision.memory

    def asked(self) -> int:
        body = json.loads(self.session.ask([0.1, 0.2], None, self.memory))
        # The memory travels as it was sealed, however often the robot has had to go on by itself.
        assert body.get("memory") == self.text
        assert body.get("played", 0) == (self.played if self.text else 0)
        number: int = body["request"]
        return number

    @precondition(lambda self: not self.held)
    @rule()
    def good(self) -> None:
        self.number += 1
        content = reply(self.number, self.asked())
        decision = self.session.told(200, content)
        assert decision.action.tolist() == [0.01, 0.5]
        self.memory, self.text = decision.memory, json.loads(content)["memory"]
        self.failures = self.played = 0

    @precondition(lambda self: not self.held)
    @rule(
        status=st.sampled_from([200, 401, 422, 500, 503]),
        content=st.binary(max_size=50)
        | st.just(reply(9, 10**6))
        | st.sampled_from([{"model": "other"}, {"gate": "off"}, {"action": [2.0, 0.0]}, {"plan": []}]),
    )
    def bad(self, status: int, content: bytes | dict[str, object]) -> None:
        request = self.asked()
        body = content if isinstance(content, bytes) else reply(9, request, **content)
        with pytest.raises(ValueError) as caught:  # noqa: PT011 - every kind of it
            self.session.told(status, body)
        self.failed(caught.value)

    @precondition(lambda self: not self.held)
    @rule(
        error=st.sampled_from(
            [TimeoutError(), ConnectionResetError("x"), ClientError("another"), KeyError(1)]
        )
    )
    def nothing(self, error: Exception) -> None:
        self.asked()
        self.failed(error)

    @rule(observation=st.sampled_from([[1.0], [float("nan"), 0.0], None, ["x", 1], [10**400, 1]]))
    def bad_input(self, observation: object) -> None:
        with pytest.raises(ValueError) as caught:  # noqa: PT011 - whatever is wrong
            self.session.ask(observation, None, self.memory)
        self.failed(caught.value)

    @precondition(lambda self: self.held)
    @rule()
    def held_back(self) -> None:
        with pytest.raises(ValueError, match="held after") as caught:
            self.session.ask([0.1, 0.2], None, self.memory)
        self.failed(caught.value)

    @rule(other=st.booleans())
    def resume(self, other: bool) -> None:
        if other:
            with pytest.raises(ClientError), self.session.anew():
                meet(self.session, action_low=[0.5, -1.0])
            return
        with self.session.anew():
            meet(self.session)
        self.held, self.failures = False, 0

    @invariant()
    def it_says_whether_it_holds(self) -> None:
        assert (self.session.held is not None) == self.held


Sessions.TestCase.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)
TestSessions = Sessions.TestCase


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"model": "another"}, "model differ"),
        ({"sha256": {"policy.onnx": "0"}}, "sha256 differ"),
        ({"threshold": 0.6}, "threshold differ"),
        ({"action_high": [0.5, 1.0]}, "action_high differ"),
        ({"guide": "ahead"}, "guide differ"),
    ],
)
def test_a_service_that_runs_another_thing_than_before_is_not_followed(changes, named) -> None:
    session = Session()
    meet(session)
    meet(session)
    with pytest.raises(ClientError, match=named):
        meet(session, **changes)
    assert session.model == model()


def test_it_raises_where_that_is_asked_for_and_has_the_action_nevertheless() -> None:
    session = Session(raises=True)
    meet(session)
    memory = unpack(json.loads(reply(1, 1))["memory"])
    session.ask([0.1, 0.2], None, memory)
    with pytest.raises(StepError, match=r"no reply within 0\.02 s") as caught:
        session.failed(TimeoutError(), 0.02)
    assert caught.value.decision.action.tolist() == PLAN[0]


def test_requests_are_stamped_by_the_robots_clock() -> None:
    session = Session(clock=lambda: 12.5)
    meet(session)
    assert json.loads(session.ask([0.1, 0.2], None, None))["stamp"] == 12.5


@pytest.mark.parametrize("most", [0, -1])
def test_a_number_of_failures_that_is_none_is_refused(most: int) -> None:
    with pytest.raises(ValueError, match="most_failures"):
        Session(most_failures=most)
