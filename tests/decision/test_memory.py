"""The memory over JSON and as a plan: the same afterwards, and nothing but what was written is taken."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from decision import (
    MEMORY,
    MOST_LATE,
    MOST_OPEN,
    PLAN_STEPS,
    SENSED,
    fall_back,
    memory_from_json,
    memory_to_json,
    next_of_plan,
)

controls = st.floats(-1.0, 1.0)


@st.composite
def memories(draw: st.DrawFn) -> np.ndarray:
    """Memories (1,) that a filter can leave."""
    memory = np.zeros(1, MEMORY)
    plan = draw(st.lists(st.tuples(controls, controls), max_size=PLAN_STEPS))
    memory["side"], memory["guided"] = draw(st.integers(-127, 127)), draw(st.integers(-1, 1))
    memory["open"] = draw(st.integers(0, MOST_OPEN))
    memory["planned"], memory["left"] = draw(st.booleans()) or bool(plan), len(plan)
    memory["plan"][0, : len(plan)] = np.array(plan).reshape(-1, 2)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    history = memory["history"]
    history["sent"], history["sensed"] = rng.uniform(-1, 1, (MOST_LATE + 1, 2)), rng.normal(size=SENSED)
    history["age"] = draw(st.integers(0, 10))
    return memory


@given(memory=memories())
def test_it_survives_json(memory) -> None:
    again = memory_from_json(json.loads(json.dumps(memory_to_json(memory[0]), allow_nan=False)))
    assert again.dtype == MEMORY
    assert again.tobytes() == memory.tobytes()


def good() -> dict:
    memory = np.zeros(1, MEMORY)
    memory["planned"], memory["left"] = True, 2
    memory["plan"][0, :2] = 0.05
    return memory_to_json(memory[0])


def history(**changes: float) -> str:
    memory = np.zeros(1, MEMORY)
    for name, value in changes.items():
        memory["history"][name] = value
    return memory_to_json(memory[0])["history"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda m: m.clear(), "memory has the fields"),
        (lambda m: m.update(extra=[0]), "extra"),
        (lambda m: m.pop("side"), "expected guided, history, open, plan, side"),
        (lambda m: m.update(side=[]), r"memory\.side"),
        (lambda m: m.update(side=0.5), r"memory\.side"),
        (lambda m: m.update(side=1e300), r"memory\.side"),
        (lambda m: m.update(side=128), r"memory\.side"),
        (lambda m: m.update(side=-128), r"memory\.side"),
        (lambda m: m.update(side=True), r"memory\.side"),
        (lambda m: m.update(side="left"), r"memory\.side"),
        (lambda m: m.update(side=None), r"memory\.side"),
        (lambda m: m.update(guided=-2), r"memory\.guided"),
        (lambda m: m.update(guided=2), r"memory\.guided"),
        (lambda m: m.update(guided=None), r"memory\.guided"),
        (lambda m: m.update(open=-1), r"memory\.open"),
        (lambda m: m.update(open=MOST_OPEN + 1), r"memory\.open"),
        (lambda m: m.update(open=False), r"memory\.open"),
        (lambda m: m.update(history=None), r"memory\.history"),
        (lambda m: m.update(history="fast"), r"memory\.history"),
        (lambda m: m.update(history="\u00e4" * 400), r"memory\.history"),
        (lambda m: m.update(history=history(age=1)[:-4]), r"memory\.history"),
        (lambda m: m.update(history=history(sent=1.5)), r"memory\.history"),
        (lambda m: m.update(history=history(sent=np.nan)), r"memory\.history"),
        (lambda m: m.update(history=history(sensed=np.inf)), r"memory\.history"),
        (lambda m: m.update(history=history(age=-1)), r"memory\.history"),
        (lambda m: m.update(plan="fast"), r"memory\.plan"),
        (lambda m: m.update(plan=[1.0]), r"memory\.plan"),
        (lambda m: m.update(plan=[[1.0, 0.0, 0.0]]), r"memory\.plan"),
        (lambda m: m.update(plan=[[1.5, 0.0]]), r"memory\.plan"),
        (lambda m: m.update(plan=[[float("nan"), 0.0]]), r"memory\.plan"),
        (lambda m: m.update(plan=[[None, 0.0]]), r"memory\.plan"),
        (lambda m: m.update(plan=[[1.0, 0.0]] * (PLAN_STEPS + 1)), r"memory\.plan"),
        (lambda m: m.update(plan={}), r"memory\.plan"),
        # No list of pairs, though as many numbers.
        (lambda m: m.update(plan=[1.0, 0.0]), r"memory\.plan"),
        (lambda m: m.update(plan=[[1.0, 0.0, 0.5, 0.5]]), r"memory\.plan"),
        (lambda m: m.update(plan=[[True, False]]), r"memory\.plan"),
        (lambda m: m.update(plan=[["0.5", "0.5"]]), r"memory\.plan"),
    ],
)
def test_what_this_version_did_not_write_is_refused_and_its_field_named(change, named) -> None:
    value = good()
    change(value)
    with pytest.raises(ValueError, match=named):
        memory_from_json(value)


@given(memory=memories(), more=st.integers(1, 4))
def test_the_plan_is_played_action_by_action_and_then_the_robot_coasts(memory, more) -> None:
    before, plan = memory.copy(), memory["plan"][0, : memory["left"][0]].copy()
    after = memory
    for k in range(len(plan) + more):
        action, after = next_of_plan(after)
        np.testing.assert_array_equal(action, plan[k : k + 1] if k < len(plan) else [[0.0, 0.0]])
        assert after["left"][0] == max(len(plan) - k - 1, 0)
        assert (after["side"] == before["side"]).all()
        assert (after["guided"] == before["guided"]).all()
    assert memory.tobytes() == before.tobytes()  # nothing of the caller's is changed


def test_each_robot_plays_its_own_plan() -> None:
    memory = np.zeros(3, MEMORY)
    memory["left"] = [0, 1, 20]
    memory["plan"] = 0.03
    action, after = next_of_plan(memory)
    np.testing.assert_array_equal(action, [[0.0, 0.0], [0.03, 0.03], [0.03, 0.03]])
    assert after["left"].tolist() == [0, 0, 19]


def test_what_a_fallback_sends_is_under_way_as_well() -> None:
    memory = np.zeros(2, MEMORY)
    memory["plan"][0, :2], memory["left"][0], memory["planned"][0] = [[0.05, 1.0], [0.04, 0.5]], 2, True
    memory["history"]["age"] = [3, 0]
    for _ in range(2):
        memory = fall_back(memory, "why").memory
    assert np.allclose(memory["history"]["sent"][0, :3], [[0.04, 0.5], [0.05, 1.0], [0.0, 0.0]])
    assert (memory["history"]["sent"][1] == 0.0).all()
    assert memory["history"]["age"].tolist() == [5, 0]
