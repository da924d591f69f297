"""What files say of their features, and the graph after them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from models import Bundle, BundleError
from models.features import KEY, FeatureNumbers, after, read, told, write

SHIPPED = Path(__file__).parents[2] / "models" / "pointgoal1"
NUMBERS = FeatureNumbers(
    tensor="cat_9",
    center=(0.1, -2.0),
    inverse=(1.0, float(np.float32(0.3))),
    limit=5.0,
    gain=4.0,
    length=0.25,
    coasting=0.519,
    sharpness=12.0,
)
TEXT = NUMBERS.model_dump_json()


def model() -> onnx.ModelProto:
    """The shipped policy, which says nothing."""
    made = onnx.load_from_string(Bundle.load(SHIPPED).policy)
    del made.metadata_props[:]
    return made


def test_what_is_written_is_read_and_the_graph_stays_what_it_is() -> None:
    made = model()
    assert read(made) is None
    assert not told(made)
    graph = made.graph.SerializeToString()
    write(made, NUMBERS)
    assert told(made)
    onnx.checker.check_model(made, full_check=True)
    again = onnx.load_from_string(made.SerializeToString())
    assert read(again) == NUMBERS
    assert again.graph.SerializeToString() == graph


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ("", "JSON"),
        ("[]", "object"),
        ("{}", r"features\.tensor"),
        (TEXT.replace("surroundings", "others"), r"features\.form: .*surroundings"),
        (TEXT.replace("0.25", "0.0"), r"features\.length: .*greater than 0"),
        (TEXT.replace("0.519", "NaN"), r"features\.coasting: .*finite"),
        (TEXT.replace("0.1,", ""), "1 of center and 2 of inverse"),
        (TEXT.replace('"cat_9"', '""'), r"features\.tensor"),
        (TEXT.replace('"gain"', '"grain"'), r"features\.gain"),
    ],
)
def test_what_makes_no_sense_is_named_in_a_line(said: str, named: str) -> None:
    made = model()
    made.metadata_props.add(key=KEY, value=said)
    assert told(made)
    with pytest.raises(BundleError, match=named) as caught:
        read(made)
    assert "\n" not in str(caught.value)


def test_the_graph_after_a_tensor_gives_what_the_whole_gives() -> None:
    whole = model()
    rest, kind = after(whole, "cat_9")
    assert kind == onnx.TensorProto.FLOAT
    assert len(rest.graph.node) < 0.3 * len(whole.graph.node)
    onnx.checker.check_model(rest, full_check=True)
    [given] = rest.graph.input
    assert given.name == "cat_9"
    observation = np.random.default_rng(0).random((9, 60), np.float32)
    whole.graph.output.append(given)
    showing = onnxruntime.InferenceSession(whole.SerializeToString())
    action, features = showing.run(None, {"observation": observation})
    (again,) = onnxruntime.InferenceSession(rest.SerializeToString()).run(None, {"cat_9": features})
    np.testing.assert_array_equal(again, action)


@pytest.mark.parametrize("tensor", ["", "nowhere", "action", "observation"])
def test_there_is_nothing_after_a_tensor_that_is_not_there(tensor: str) -> None:
    with pytest.raises(BundleError, match=r"features\.tensor: the graph has no tensor"):
        after(model(), tensor)
