"""What the tests of several rooms need: a tiny bundle with random weights, made without the trainer."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from models import Bundle, Manifest, write_bundle
from pointgoal.observation import HAZARD_RADIUS, layout

OPSET = 17


def mlp(
    output: str, outputs: int, seed: int, size: int = 60, nodes: list[onnx.NodeProto] | None = None
) -> bytes:
    """A one-layer network "observation" → output; `nodes` go from "raw" to the output (by default a clip)."""
    rng = np.random.default_rng(seed)
    weights = numpy_helper.from_array(rng.normal(0, 0.3, (outputs, size)).astype(np.float32), "weights")
    tail = nodes or [helper.make_node("Tanh", ["raw"], [output])]
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["observation", "weights"], ["raw"], transB=1), *tail],
        output,
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", size])],
        [
            helper.make_tensor_value_info(
                output, TensorProto.FLOAT, ["batch", 2] if outputs == 2 else ["batch"]
            )
        ],
        [weights, numpy_helper.from_array(np.array([-1]), "flat")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    return bytes(model.SerializeToString())


def multiplier_mlp(seed: int = 1, size: int = 60, nodes: list[onnx.NodeProto] | None = None) -> bytes:
    """A multiplier network: a Softplus of one linear layer, flattened to [batch]."""
    tail = nodes or [
        helper.make_node("Softplus", ["raw"], ["positive"]),
        helper.make_node("Reshape", ["positive", "flat"], ["multiplier"]),
    ]
    return mlp("multiplier", 1, seed, size, tail)


def manifest(level: int = 1, **changes: object) -> Manifest:
    """A manifest that fits the tiny networks."""
    blocks = layout(level)
    fields: dict[str, object] = {
        "name": "tiny",
        "created": datetime(2026, 1, 1, tzinfo=UTC),
        "task": f"PointGoal{level}-v0",
        "level": level,
        "algorithm": "random",
        "observation_layout": blocks.to_json(),
        "observation_size": blocks.size,
        "action_low": [-1.0, -1.0],
        "action_high": [1.0, 1.0],
        "threshold": 0.5,
        "threshold_source": "set by hand",
        "hazard_radius": HAZARD_RADIUS,
        "opset": OPSET,
    }
    return Manifest.model_validate(fields | changes)


@pytest.fixture(scope="session")
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of level 1 with random weights, shared by all tests: do not change it."""
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture
def own_bundle(tmp_path: Path) -> Path:
    """A bundle like `tiny_bundle` that a test may damage."""
    return make_bundle(tmp_path / "tiny")


def make_bundle(
    path: Path, policy: bytes | None = None, multiplier: bytes | None = None, level: int = 1
) -> Path:
    """Writes a bundle of tiny networks, or of the given ones."""
    size = layout(level).size
    bundle: Bundle = write_bundle(
        path,
        policy or mlp("action", 2, 0, size),
        multiplier or multiplier_mlp(1, size),
        manifest(level),
    )
    return bundle.path


@pytest.fixture
def make_bundle_of() -> Callable[..., Path]:
    """Makes a bundle of tiny networks at a level, the multiplier's ending in some operators of one input."""

    def make(path: Path, level: int = 1, multiplier_tail: list[str] | None = None) -> Path:
        if multiplier_tail is None:
            return make_bundle(path, level=level)
        names = ["flattened", *(f"tail{k}" for k in range(1, len(multiplier_tail))), "multiplier"]
        nodes = [
            helper.make_node("Softplus", ["raw"], ["positive"]),
            helper.make_node("Reshape", ["positive", "flat"], ["flattened"]),
            *(
                helper.make_node(operator, [before], [after])
                for operator, before, after in zip(multiplier_tail, names[:-1], names[1:], strict=True)
            ),
        ]
        return make_bundle(path, multiplier=multiplier_mlp(nodes=nodes), level=level)

    return make
