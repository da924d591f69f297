"""Who cannot decide goes on with the plan, and then coasts."""

import numpy as np

from decision import MEMORY, SAFE_ACTION, Mode, OpenedBy, Origin, fall_back


def test_each_robot_goes_on_with_its_own_plan_and_then_does_what_is_safe():
    memory = np.zeros(3, MEMORY)
    memory["left"], memory["side"] = [0, 1, 2], [5, -5, 0]
    memory["plan"][1:, :2] = [(-0.05, 0.5), (0.05, -0.5)]
    before = memory.copy()
    decided = fall_back(memory, "no reply", 0.5)
    np.testing.assert_array_equal(decided.action, [SAFE_ACTION, (-0.05, 0.5), (-0.05, 0.5)])
    assert (decided.mode == Mode.FALLBACK).all()
    assert (decided.origin == Origin.PLAN).all()
    assert (decided.opened_by == OpenedBy.FAULT).all()
    assert decided.reason == ["no reply"] * 3
    assert not decided.certified.any()
    assert np.isnan(decided.barrier).all()
    assert memory.tobytes() == before.tobytes()
    again = fall_back(decided.memory, "no reply", safe=(0.1, 0.2))
    np.testing.assert_array_equal(again.action, [(0.1, 0.2), (0.1, 0.2), (0.05, -0.5)])
    assert again.memory["side"].tolist() == [5, -5, 0]
