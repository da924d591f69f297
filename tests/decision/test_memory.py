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
    next_of_plan,
    pack,
    unpack,
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
def test_it_survives_as_text(memory) -> None:
    again = unpack(json.loads(json.dumps(pack(memory.tobytes()))))
    assert again.dtype == MEMORY
    assert again.tobytes() == memory.tobytes()


@pytest.mark.parametrize("text", ["", "fast", "\u00e4" * 876, "A" * 872, "A" * 880, "-" + "A" * 875])
def test_what_is_no_memory_is_refused(text) -> None:
    with pytest.raises(ValueError, match=f"base64 of {MEMORY.itemsize} bytes"):
        unpack(text)


@pytest.mark.parametrize("left", [-1, PLAN_STEPS + 1])
def test_a_plan_that_is_longer_than_a_plan_is_refused(left) -> None:
    memory = np.zeros(1, MEMORY)
    memory["left"] = left
    with pytest.raises(ValueError, match=f"a plan of {left} actions"):
        unpack(pack(memory.tobytes()))


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
