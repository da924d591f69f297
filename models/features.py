"""What an ONNX file says of its features: from which numbers, and by which tensor they reach its network.

The graph computes them itself, for whoever runs it. Who knows the formulas can compute them some other way
and run only what comes after the tensor.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import onnx
from onnx.utils import Extractor
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from models.errors import BundleError

KEY = "lagnet.features"
"""The entry of a model's metadata_props that holds them, as JSON."""

Positive = Annotated[float, Field(gt=0.0)]


class FeatureNumbers(BaseModel):
    """The numbers in the formulas of `trainer.features`, which has them in words.

    Attributes:
        form: which formulas.
        tensor: the name of the features in the graph: [batch, size].
        center: of each of an observation's numbers, its mean.
        inverse: of each, one over its standard deviation.
        limit: normalised observations are clipped to ± this.
        gain: largest size of most of the features.
        length: over which the nearness of a hazard falls by a factor e [m].
        coasting: decay time of the robot's speed without thrust [s].
        sharpness: concentration of the directions of the map.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    form: Literal["surroundings"] = "surroundings"
    tensor: Annotated[str, Field(min_length=1)]
    center: tuple[float, ...]
    inverse: tuple[float, ...]
    limit: Positive
    gain: Positive
    length: Positive
    coasting: float
    sharpness: float

    @model_validator(mode="after")
    def _one_for_each(self) -> Self:
        if len(self.center) != len(self.inverse):
            raise ValueError(f"{len(self.center)} of center and {len(self.inverse)} of inverse")
        return self


def write(model: onnx.ModelProto, numbers: FeatureNumbers) -> None:
    """Writes them into a model that has none."""
    model.metadata_props.add(key=KEY, value=numbers.model_dump_json())


def told(model: onnx.ModelProto) -> bool:
    """Whether a model says anything of its features."""
    return any(entry.key == KEY for entry in model.metadata_props)


def read(model: onnx.ModelProto) -> FeatureNumbers | None:
    """What a model says of its features; None if it says nothing.

    Raises:
        BundleError: if it says what this version does not understand.
    """
    for entry in model.metadata_props:
        if entry.key == KEY:
            try:
                return FeatureNumbers.model_validate_json(entry.value)
            except ValidationError as error:
                first = error.errors(include_url=False)[0]
                where = ".".join(str(part) for part in first["loc"])
                raise BundleError(f"{KEY}{'.' + where if where else ''}: {first['msg']}") from error
    return None


def after(model: onnx.ModelProto, tensor: str) -> tuple[onnx.ModelProto, int]:
    """What a graph computes from one of its tensors: all of its outputs.

    Returns:
        The model, whose one input is the tensor, and the tensor's TensorProto.DataType.

    Raises:
        BundleError: if there is no such tensor.
    """
    inferred = onnx.shape_inference.infer_shapes(model)
    known = {value.name: value.type.tensor_type.elem_type for value in inferred.graph.value_info}
    if tensor not in known:
        raise BundleError(f"{KEY}.tensor: the graph has no tensor {tensor!r}")
    outputs = [value.name for value in model.graph.output]
    return Extractor(inferred).extract_model([tensor], outputs), known[tensor]
