"""An evaluation whose service goes away ends; a late reply is in its figures."""

from __future__ import annotations

import pytest

from decision import OpenedBy
from evaluation.closed_loop import run_episodes
from evaluation.errors import ServiceError, ServiceGoneError
from evaluation.watched import Watched


def gone() -> None:
    raise ServiceError("http://robot: connection refused")


def there() -> None:
    pass


def never() -> None:
    raise AssertionError("a failed connection needs no further question")


@pytest.mark.parametrize("kind", ["connection", "bad reply", "RuntimeError"])
@pytest.mark.parametrize("robots", [1, 3])
def test_one_robots_failed_connection_ends_it(dying, kind, robots) -> None:
    fleet = dying(kind, 20, robots)
    with pytest.raises(ServiceGoneError, match=f"{kind}: refused"):
        run_episodes("PointGoal1-v0", Watched(fleet, never), 3)
    assert fleet.steps == 21


def test_late_replies_are_measured_while_the_service_is_there(dying) -> None:
    episodes = run_episodes("PointGoal1-v0", Watched(dying("time-out", 990, 2), gone), 3)
    assert episodes.opened_by[OpenedBy.FAULT].tolist() == [10, 10, 0]
    assert episodes.reasons.count("time-out: refused") == 20
    episodes = run_episodes("PointGoal1-v0", Watched(dying("time-out", 990, 3), there), 3)
    assert episodes.opened_by[OpenedBy.FAULT].tolist() == [10, 10, 10]


def test_no_reply_to_anyone_from_a_service_that_is_gone_ends_it(dying) -> None:
    fleet = dying("time-out", 20, 3)
    with pytest.raises(ServiceGoneError, match="connection refused"):
        run_episodes("PointGoal1-v0", Watched(fleet, gone), 3)
    assert fleet.steps == 21


def test_a_fallback_of_the_services_own_is_a_decision(scripted, dying) -> None:
    """The scripted service falls back every tenth step, and its robots have no fault."""
    fleet = dying("connection", 10**9, 0)
    assert len(run_episodes("PointGoal1-v0", Watched(fleet, never), 1).reasons) == 100


def test_one_that_dies_while_decisions_are_timed_ends_it_too(dying) -> None:
    class Late(dying):
        def decide(self, observation, hazards=None, memory=None):
            self.faults.counts["connection"] += 1
            return super().decide(observation, hazards, memory)

    with pytest.raises(ServiceGoneError):
        run_episodes("PointGoal1-v0", Watched(Late("connection", 10**9, 0), never), 1)
