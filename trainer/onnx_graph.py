"""The ONNX graphs of a policy and of a multiplier network: traced from what training computes."""

import copy
import logging
from collections.abc import Callable

import onnx
import torch
from torch import Tensor, nn

from models import features as described
from models.features import FeatureNumbers
from trainer.actions import ActionRange
from trainer.features import COASTING, GAIN, SHARPNESS, Features
from trainer.networks import Shape, mlp
from trainer.normaliser import CLIP

OPSET = 20
"""What the exporter writes without converting."""
FEATURES = "features"
"""What a graph calls them."""


class Policy(nn.Module):
    """Observation [B, n] → action [B, a]: the policy's mean, as it is sent to the robot; float32 outside.

    Args:
        theta: the network's parameters [P].
        shape: its layer sizes.
        features: its inputs, in the precision that all is computed in.
        actions: from draws to actions.
    """

    theta: Tensor

    def __init__(self, theta: Tensor, shape: Shape, features: Features, actions: ActionRange) -> None:
        super().__init__()
        self.features = features
        self.shape = shape
        self.actions = actions
        self.register_buffer("theta", theta.detach().to(features.dtype))

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [B, a] of raw observations [B, n]."""
        inputs = self.features(observation.to(self.features.dtype))
        return self.actions.sent(mlp(self.theta, inputs, self.shape)).float()


class Multiplier(nn.Module):
    """Observation [B, n] → multiplier [B].

    The features are the policy's, in its precision, so that both graphs can share them; after them nothing
    magnifies the rounding of single precision.
    """

    def __init__(self, network: Callable[[Tensor], Tensor], features: Features) -> None:
        super().__init__()
        self.features = features
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        """Multipliers [B] of raw observations [B, n]."""
        return self.network(self.features(observation.to(self.features.dtype)).float())


class Constant(nn.Module):
    """Observation [B, n] → multiplier [B]: the same value in every state."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def forward(self, observation: Tensor) -> Tensor:
        """The value [B] for observations [B, n]."""
        return observation.sum(1) * 0.0 + self.value


def exact(features: Features) -> Features:
    """The features in double precision; the constants stay the single ones."""
    return copy.deepcopy(features).double()


class _Showing(nn.Module):
    """A network that gives its features as well: the tracer names what is given."""

    def __init__(self, network: nn.Module, features: Features) -> None:
        super().__init__()
        self.network = network
        self.features = features

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The network's output and its features [B, m] for raw observations [B, n]."""
        shown: list[Tensor] = []
        hook = self.features.register_forward_hook(lambda _, __, features: shown.append(features))
        output = self.network(observation)
        hook.remove()
        return output, shown[0]


def graph(network: nn.Module, inputs: int, output: str) -> bytes:
    """Traces a network.

    Args:
        network: a module from "observation" [B, n] to one tensor.
        inputs: n.
        output: the tensor's name.

    Returns:
        The ONNX file's bytes, checked. If the network has features with surroundings, they say so, see
        `models.features`.
    """
    # It warns of every package it could also convert operators of.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    features = _described(network)
    with torch.no_grad():
        program = torch.onnx.export(
            (_Showing(network, features) if features else network).eval(),
            (torch.zeros(2, inputs),),
            input_names=["observation"],
            output_names=[output, FEATURES] if features else [output],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _strip(model)
    if features:
        del model.graph.output[1:]
        described.write(model, numbers(features))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _described(network: nn.Module) -> Features | None:
    """A network's features, if a graph says of them what they are: those without surroundings cost little."""
    features = getattr(network, "features", None)
    return features if isinstance(features, Features) and features.surroundings else None


def numbers(features: Features) -> FeatureNumbers:
    """What a graph says of features with surroundings."""
    normaliser, surroundings = features.normaliser, features.surroundings
    assert surroundings is not None
    return FeatureNumbers(
        tensor=FEATURES,
        center=tuple(normaliser.center.tolist()),
        inverse=tuple(normaliser.inverse.tolist()),
        limit=CLIP,
        gain=GAIN,
        length=surroundings.length,
        coasting=COASTING,
        sharpness=SHARPNESS,
    )


def _strip(model: onnx.ModelProto) -> None:
    """Takes out where each node comes from: places in the source tree of the machine that exported."""
    del model.metadata_props[:], model.graph.metadata_props[:], model.graph.value_info[:]
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input, *model.graph.output):
        del part.metadata_props[:]
        part.doc_string = ""
