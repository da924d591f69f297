"""The filter's memory over JSON: the same afterwards, and nothing but what was written is taken."""

from __future__ import annotations

import json

import numpy as np
import pytest

from filter import FilterMemory
from monitor import memory_from_json, memory_to_json
from monitor.memory import join, take


def test_it_survives_json() -> None:
    memory = FilterMemory.empty(1)
    for name in FilterMemory.__dataclass_fields__:
        getattr(memory, name).fill(1)
    again = memory_from_json(json.loads(json.dumps(memory_to_json(memory))))
    assert again is not None
    for name in FilterMemory.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(memory, name), strict=True)
    assert memory_to_json(None) is None
    assert memory_from_json(None) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.clear(),
        lambda m: m.update(extra=[0]),
        lambda m: m.update(side=[]),
        lambda m: m.update(side=[0, 0]),
        lambda m: m.update(side=[0.5]),
        lambda m: m.update(side=[1e300]),
    ],
)
def test_what_this_version_did_not_write_is_refused(change) -> None:
    value = memory_to_json(FilterMemory.empty(1))
    assert value is not None
    change(value)
    with pytest.raises(ValueError, match="memory"):
        memory_from_json(value)


def test_robots_shares_make_the_batch_again() -> None:
    memory = FilterMemory.empty(5)
    memory.side[:] = [0, 1, -1, 1, 0]
    again = join([take(memory, i) for i in range(5)])
    assert again is not None
    np.testing.assert_array_equal(again.side, memory.side, strict=True)
    assert join([take(memory, 0), None]) is None
