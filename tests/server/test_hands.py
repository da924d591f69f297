"""A decision in time, or none: threads that hang are left to themselves, and what comes late is dropped."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from fastapi.testclient import TestClient

from decision import Faults
from monitor import Monitor
from server.app import create_app
from server.hands import MOST_HUNG, Hands, LateError
from server.safety import Safety

PLAN = [[0.05, -1.0], [0.03, 0.0]]


def hanging(gate: threading.Event) -> Callable[[], str]:
    def make() -> str:
        gate.wait(10.0)
        return "late"

    return make


def test_what_hangs_is_left_and_what_comes_late_is_dropped() -> None:
    async def run() -> None:
        hands, gate = Hands(0.05), threading.Event()
        for hung in range(1, MOST_HUNG + 1):
            with pytest.raises(LateError, match="within 50 ms"):
                await hands.make(hanging(gate))
            assert hands.hung == hung
            if hung < MOST_HUNG:
                # Another thread has taken its place.
                assert await hands.make(lambda: threading.current_thread().name) == f"decisions-{hung}"
        started = time.perf_counter()
        for _ in range(100):
            with pytest.raises(LateError, match="hang"):
                await hands.make(lambda: "never begun")
        assert time.perf_counter() - started < 0.05
        gate.set()
        end = time.perf_counter() + 5.0
        while hands.hung and time.perf_counter() < end:
            await asyncio.sleep(0.001)
        assert hands.hung == 0
        # Nobody is given what was made for another; one thread is left.
        assert [await hands.make(lambda k=k: k) for k in range(50)] == list(range(50))
        end = time.perf_counter() + 5.0
        while hands._threads > 1 and time.perf_counter() < end:
            await asyncio.sleep(0.001)
        assert hands._threads == 1

    asyncio.run(run())


def test_what_waits_behind_one_that_hangs_goes_on_in_its_place() -> None:
    async def run() -> list[object]:
        hands, gate = Hands(0.4), threading.Event()
        first = asyncio.create_task(hands.make(hanging(gate)))
        await asyncio.sleep(0.2)
        others = [asyncio.create_task(hands.make(lambda k=k: k)) for k in range(3)]
        told = await asyncio.gather(first, *others, return_exceptions=True)
        gate.set()
        return told

    late, *others = asyncio.run(run())
    assert isinstance(late, LateError)
    assert others == [0, 1, 2]


def test_what_is_not_begun_in_time_is_never_begun() -> None:
    begun = []

    async def run() -> None:
        hands, gate = Hands(0.05, most=1), threading.Event()
        first = asyncio.create_task(hands.make(hanging(gate)))
        await asyncio.sleep(0.01)
        second = asyncio.create_task(hands.make(lambda: begun.append("second")))
        assert all(
            isinstance(told, LateError)
            for told in await asyncio.gather(first, second, return_exceptions=True)
        )
        gate.set()
        end = time.perf_counter() + 5.0
        while hands.hung and time.perf_counter() < end:
            await asyncio.sleep(0.001)
        assert await hands.make(lambda: "third") == "third"

    asyncio.run(run())
    assert begun == []


def test_what_is_raised_is_raised_and_the_thread_lives_on() -> None:
    async def run() -> None:
        hands = Hands(1.0)
        for error in (ValueError("x"), SystemExit(), MemoryError()):
            with pytest.raises(type(error)):
                await hands.make(lambda error=error: (_ for _ in ()).throw(error))
        assert await hands.make(lambda: threading.current_thread().name) == "decisions-0"

    asyncio.run(run())


class Hanging(Monitor):
    """A monitor that hangs about observations that begin with 9."""

    def __init__(self, monitor: Monitor) -> None:
        self.__dict__ |= monitor.__dict__ | {"faults": Faults()}
        self.gate_of_time = threading.Event()

    def decide(self, observation, hazards=None, memory=None):
        if observation[0] == 9.0:
            self.gate_of_time.wait(10.0)
        return super().decide(observation, hazards, memory)

    def decide_batch(self, observation, hazards=None, memory=None):
        if observation[0, 0] == 9.0:
            self.gate_of_time.wait(10.0)
        return super().decide_batch(observation, hazards, memory)


@contextmanager
def limited(
    monitor: Monitor, key: bytes | None = None, **limits: object
) -> Iterator[tuple[TestClient, Hanging]]:
    slow = Hanging(monitor)
    with TestClient(create_app(slow, safety=Safety(**limits), memory_key=key)) as app:
        try:
            yield app, slow
        finally:
            slow.gate_of_time.set()


def test_past_the_deadline_the_plan_goes_on_and_then_the_robot_stops(
    monitor, observation, sealed, memory_key
) -> None:
    with limited(monitor, memory_key, deadline=0.1) as (app, slow):
        hung = {"observation": [9.0, *observation[1:]], "memory": sealed(PLAN)}
        actions = []
        for _ in range(MOST_HUNG + 2):
            content = app.post("/act", json=hung).json()
            assert (content["mode"], content["origin"], content["opened_by"]) == ("fallback", "plan", "fault")
            assert "100 ms" in content["reason"] or "hang" in content["reason"]
            actions.append(content["action"])
            hung["memory"] = content["memory"]
            if len(actions) == 1:
                # Another robot's decision is not held up.
                told = app.post("/act", json={"observation": observation, "request": 7}).json()
                assert told["reason"] is None
                assert told["request"] == 7
        assert actions == [*PLAN, *[[0.0, 0.0]] * MOST_HUNG]
        assert slow.faults.counts == {"deadline": MOST_HUNG + 2}
        assert app.get("/healthz").status_code == 200


def test_a_batch_past_the_deadline(monitor, observation, sealed, memory_key) -> None:
    with limited(monitor, memory_key, deadline=0.1) as (app, _):
        robots = [
            {"observation": [9.0, *observation[1:]], "memory": sealed(PLAN), "request": 1},
            {"observation": observation[1:]},
            {"observation": observation, "request": 3},
        ]
        first, second, third = app.post("/act/batch", json={"robots": robots}).json()["replies"]
        assert (first["mode"], first["action"], first["request"]) == ("fallback", PLAN[0], 1)
        assert second["detail"][0]["loc"] == ["body", "observation"]
        assert (third["mode"], third["action"], third["request"]) == ("fallback", [0.0, 0.0], 3)


def test_without_a_deadline_it_takes_as_long_as_it_takes(monitor, observation) -> None:
    with limited(monitor) as (app, slow):
        threading.Timer(0.3, slow.gate_of_time.set).start()
        assert app.post("/act", json={"observation": [9.0, *observation[1:]]}).json()["mode"] != "fallback"


def test_a_request_that_cannot_be_read_is_refused_past_the_deadline_too(monitor, observation) -> None:
    with limited(monitor, deadline=1e-9) as (app, _):
        assert app.post("/act", json={"observation": observation[1:]}).status_code == 422


def test_whoever_finds_no_place_is_told_at_once(monitor, observation) -> None:
    with limited(monitor, max_in_flight=2, max_in_flight_all=3) as (app, slow):
        hung = {"observation": [9.0, *observation[1:]]}
        told: list[int] = []

        def ask() -> None:
            told.append(app.post("/act", json=hung).status_code)

        asking = [threading.Thread(target=ask) for _ in range(2)]
        for thread in asking:
            thread.start()
        end = time.monotonic() + 5.0
        while app.app._app._places._sum < 2 and time.monotonic() < end:
            time.sleep(0.001)
        reply = app.post("/act", json={"observation": observation})
        assert reply.status_code == 503
        assert reply.headers["retry-after"] == "1"
        assert "this address" in reply.json()["detail"][0]["msg"]
        assert app.get("/healthz").status_code == 200
        slow.gate_of_time.set()
        for thread in asking:
            thread.join()
        assert told == [200, 200]
        assert app.post("/act", json={"observation": observation}).status_code == 200
