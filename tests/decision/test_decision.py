"""One carrier: what a batch says of a robot is what its row says."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import FrozenInstanceError, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from decision import MEMORY, PLAN_STEPS, Decision, Decisions, Mode, OpenedBy, Origin, texts, unknown

N = 7


@pytest.fixture
def batch() -> Decisions:
    rng = np.random.default_rng(0)
    memory = np.zeros(N, MEMORY)
    memory["left"] = rng.integers(0, PLAN_STEPS + 1, N)
    memory["plan"] = rng.uniform(-1, 1, (N, PLAN_STEPS, 2))
    memory["side"] = rng.integers(-50, 51, N)
    return Decisions(
        action=rng.uniform(-1, 1, (N, 2)),
        nominal_action=rng.uniform(-1, 1, (N, 2)),
        mode=np.array([*Mode, *Mode][:N], dtype=np.str_),
        origin=np.array(["", *Origin][:N], dtype=np.str_),
        certified=rng.random(N) < 0.5,
        barrier=rng.normal(size=N),
        hazard=rng.integers(-1, 8, N),
        reason=["broken" if k % 3 == 0 else None for k in range(N)],
        risk=rng.random(N),
        threshold=0.5,
        opened_by=np.array(["", *OpenedBy, "", ""][:N], dtype=np.str_),
        novelty=rng.random(N),
        suspect=np.array(["gyro", "", "hazards_lidar", *[""] * N][:N], dtype=np.str_),
        memory=memory,
    )


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray | np.void):
        return a.tobytes() == np.asarray(b).tobytes()
    return a == b


def test_one_and_many_have_the_same_fields() -> None:
    assert [field.name for field in fields(Decision)] == [field.name for field in fields(Decisions)]


def test_a_decision_is_the_batchs_row(batch) -> None:
    assert len(batch) == N
    for k in range(N):
        one = batch[k]
        assert isinstance(one, Decision)
        for name in ("action", "nominal_action", "memory"):
            assert same(getattr(one, name), getattr(batch, name)[k])
        for name in ("certified", "barrier", "risk", "reason"):
            assert getattr(one, name) == getattr(batch, name)[k]
        assert one.mode is Mode(batch.mode[k])
        assert (one.origin or "") == batch.origin[k]
        assert (one.opened_by or "") == batch.opened_by[k]
        assert one.hazard == (batch.hazard[k] if batch.hazard[k] >= 0 else None)
        assert one.threshold == 0.5
        assert one.gate_open == batch.gate_open[k] == (one.opened_by is not None)
        np.testing.assert_array_equal(one.plan, batch.memory["plan"][k, : batch.memory["left"][k]])
        # Plain values, as the wire wants them.
        assert type(one.certified) is bool
        assert type(one.barrier) is type(one.risk) is float
        assert one.hazard is None or type(one.hazard) is int


def test_a_row_is_whole_and_stays_as_it_is(batch) -> None:
    one = batch[0]
    assert list(vars(one)) == [field.name for field in fields(Decision)]
    with pytest.raises(FrozenInstanceError):
        one.mode = Mode.NOMINAL


def test_what_is_sent_is_changed_unless_it_is_nominal(batch) -> None:
    assert batch.changed.tolist() == [mode != "nominal" for mode in batch.mode.tolist()]
    for mode in (texts(Mode.NOMINAL, N), np.array([Mode.NOMINAL] * N, dtype=np.str_)):
        batch.mode = mode
        assert batch.changed.tolist() == [False] * N


def test_rows_make_the_batch_again(batch) -> None:
    again = Decisions.of([batch[k] for k in range(N)])
    for field in fields(Decisions):
        assert same(getattr(batch, field.name), getattr(again, field.name)), field.name
    assert again.memory.dtype == MEMORY


@pytest.mark.parametrize("cuts", [(0, N), (0, 3, N), (0, 1, 2, N)])
def test_parts_make_the_batch_again(batch, cuts) -> None:
    parts = [Decisions.of([batch[k] for k in range(start, stop)]) for start, stop in pairwise(cuts)]
    again = Decisions.join(parts)
    for field in fields(Decisions):
        a, b = getattr(batch, field.name), getattr(again, field.name)
        # Texts are as wide as the widest of their part.
        words = field.name in ("mode", "origin", "opened_by", "suspect")
        assert a.tolist() == b.tolist() if words else same(a, b)


def test_texts_are_wide_enough_for_every_name_and_not_to_be_written_to() -> None:
    for name in (*Mode, *Origin, *OpenedBy):
        assert texts(name, 3).tolist() == [name] * 3
    with pytest.raises(ValueError, match="read-only"):
        texts("", 3)[0] = "x"
    with pytest.raises(ValueError, match="read-only"):
        unknown(3)[0] = 1.0


def test_what_is_told_of_policy_and_gate_changes_nothing_else(batch) -> None:
    said = texts(OpenedBy.RISK, N), np.zeros(N), texts("", N)
    told = batch.told(np.zeros((N, 2)), np.ones(N), 0.25, *said)
    assert told.threshold == 0.25
    changed = {"nominal_action", "risk", "threshold", "opened_by", "novelty", "suspect"}
    for field in fields(Decisions):
        same_one = getattr(told, field.name) is getattr(batch, field.name)
        assert same_one != (field.name in changed), field.name


def test_the_names_are_texts_for_users() -> None:
    assert [*Mode] == ["nominal", "guided", "filtered", "fallback"]
    assert [*Origin] == ["barrier", "circulation", "search", "plan", "least harm", "guide"]
    assert [*OpenedBy] == ["always", "risk", "barrier", "novelty", "dwell", "fault"]


SCRIPT = """
import sys
for name in ("numba", "scipy", "onnxruntime", "onnx", "pydantic", "fastapi", "osqp", "qpsolvers", "torch",
             "mujoco", "gymnasium"):
    sys.modules[name] = None
import decision
decision.next_of_plan(decision.unpack(decision.pack(decision.memory_of(1, None).tobytes())))
rooms = {"system", "filter", "guide", "inference", "novelty", "monitor", "models", "server"}
rooms |= {"trainer", "evaluation", "pointgoal"}
assert not rooms & set(sys.modules)
foreign = {name.split(".")[0] for name in sys.modules} - set(sys.stdlib_module_names) - {"decision", "numpy"}
print(sorted(name for name in foreign if not name.startswith("_") and "." not in name))
"""


def test_it_needs_numpy_alone() -> None:
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, cwd=root, check=False
    )
    assert result.returncode == 0, result.stderr
