import threading

import numpy as np
import pytest

from decision import MEMORY, fall_back, in_parts, parts


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize(("count", "cores", "calls"), [(1, 4, 1), (399, 4, 1), (401, 4, 2), (1000, 3, 3)])
def test_every_robot_is_decided_about_once_in_order(monkeypatch, count, cores, calls, given):
    monkeypatch.setattr(parts, "cores", lambda: cores)
    numbers = np.arange(count, dtype=np.float64)
    hazards = np.tile(numbers[:, None, None], (1, 2, 2)) if given else None
    memory = np.zeros(count, MEMORY)
    memory["side"] = numbers % 100
    sizes = []

    def decide(observation, hazards, memory):
        sizes.append(len(observation))
        assert (hazards is None) == (not given)
        if given:
            np.testing.assert_array_equal(hazards[:, 0, 0], observation[:, 0])
        decided = fall_back(memory, f"robot {int(observation[0, 0])} is the first")
        decided.risk = observation[:, 0]
        return decided

    decided = in_parts(decide, numbers[:, None], hazards, memory)
    assert len(sizes) == calls
    np.testing.assert_array_equal(decided.risk, numbers)
    np.testing.assert_array_equal(decided.memory["side"], numbers % 100)
    assert len(set(decided.reason)) == calls


def test_parts_run_side_by_side(monkeypatch):
    monkeypatch.setattr(parts, "cores", lambda: 2)
    both = threading.Barrier(2, timeout=10.0)

    def decide(observation, hazards, memory):
        both.wait()
        return fall_back(memory, "together")

    assert len(in_parts(decide, np.zeros((1000, 1)), None, np.zeros(1000, MEMORY))) == 1000


def test_what_goes_wrong_in_a_part_is_raised(monkeypatch):
    monkeypatch.setattr(parts, "cores", lambda: 2)

    def decide(observation, hazards, memory):
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        in_parts(decide, np.zeros((1000, 1)), None, np.zeros(1000, MEMORY))
