"""manifest.json: what a bundle says about itself."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, field_validator, model_validator

FORMAT_VERSION: Literal[1] = 1
"""Version of the bundle format that this code reads and writes."""
POLICY_FILE = "policy.onnx"
MULTIPLIER_FILE = "multiplier.onnx"
NOVELTY_FILE = "novelty.npz"
MANIFEST_FILE = "manifest.json"

NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
"""What a bundle may be called."""

Positive = Annotated[int, Field(ge=1)]
Pair = tuple[float, float]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ObservationBlock(_Strict):
    """One named run of numbers in the observation, as in `pointgoal.observation.Block`.

    Attributes:
        name: the sensor.
        start: index of its first number.
        size: how many numbers.
        unit: their unit; "1" for dimensionless readings.
    """

    name: Annotated[str, Field(min_length=1)]
    start: Annotated[int, Field(ge=0)]
    size: Positive
    unit: str


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Share = Annotated[float, Field(ge=0.0, le=1.0)]

MOST_SCORES = 200
"""As many scores of a calibration's episodes are kept at most."""
_ONLY_IN = {
    "closed loop": ("violated_without_floor", "hazards", "tried", "seed"),
    "onset": ("violating", "logs"),
}
_MAY_BE_MISSING = {"violated_without_floor"}


class Calibration(_Strict):
    """How the gate was chosen, and what that promises. What one form alone has, the other leaves out.

    Attributes:
        method: "closed loop": of gates in a fixed order, from the most open one on, each was tried on fresh
            episodes of the loop that is deployed; the last one that passed was taken. "onset": by the
            smallest λ ahead of the violations in a robot's own logs, driven without a filter.
        miss_rate: α: with at most this probability an episode is missed. Closed loop: the barrier had to open
            the gate before λ did. Onset: of those with a violation, λ was not above the threshold all through
            the lead time before each one.
        confidence: with this confidence 1 − δ.
        episodes: that each gate was tried on; that the logs hold.
        missed: of those, under the gate that was taken.
        violated_without_floor: closed loop: of as many episodes with the barrier's floor off, how many had a
            violation.
        scores: of a sample of its episodes, rising, for `lagnet-calibrate --check`: how silent λ was where it
            had to speak, see `evaluation.exchange`; None: none were kept.
        violating: onset: episodes with a violation, n.
        logs: onset: the SHA-256 of each log.
        hazards: closed loop: what the filter knew of them.
        tried: closed loop: how many gates.
        seed: closed loop: of the episodes.
        multiplier: the SHA-256 of the multiplier.onnx that it is for.
    """

    method: Literal["closed loop", "onset"]
    miss_rate: Annotated[float, Field(gt=0.0, lt=1.0)]
    confidence: Annotated[float, Field(gt=0.0, lt=1.0)]
    episodes: Positive
    missed: Annotated[int, Field(ge=0)]
    violated_without_floor: Annotated[int, Field(ge=0)] | None = None
    scores: Annotated[tuple[Share, ...], Field(min_length=1, max_length=MOST_SCORES)] | None = None
    violating: Positive | None = None
    logs: Annotated[tuple[Sha256, ...], Field(min_length=1)] | None = None
    hazards: Literal["given", "lidar"] | None = None
    tried: Positive | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    multiplier: Sha256

    @model_validator(mode="after")
    def _has_what_its_form_has(self) -> Self:
        for form, names in _ONLY_IN.items():
            for name in names:
                there, here = getattr(self, name) is not None, form == self.method
                if there and not here:
                    raise ValueError(f"{name}: a calibration of the form {self.method!r} has none")
                if here and not there and name not in _MAY_BE_MISSING:
                    raise ValueError(f"{name}: a calibration of the form {self.method!r} needs it")
        return self


class NoveltySource(_Strict):
    """Where novelty.npz comes from, and what its limits let pass.

    Attributes:
        episodes: that it was learnt from, in the closed loop, and
        limit_episodes: others, by which the limits were found: they had no alarm.
        hours: that these lasted.
        alarms_per_hour: at most so many false alarms an hour, with 95 % confidence.
        hazards: what the filter knew of them.
        seed: of the episodes.
    """

    episodes: Positive
    limit_episodes: Positive
    hours: Annotated[float, Field(gt=0.0)]
    alarms_per_hour: Annotated[float, Field(gt=0.0)]
    hazards: Literal["given", "lidar"]
    seed: Annotated[int, Field(ge=0)]


class Manifest(_Strict):
    """What a bundle says about itself; written as manifest.json.

    Attributes:
        format_version: version of the bundle format.
        name: the bundle's name: letters, digits, dot, dash, underscore.
        created: when it was exported, with its time zone.
        task: gymnasium id of the task it was trained on.
        level: the task's level.
        algorithm: what trained it.
        observation_layout: the observation's blocks, in order, without gaps.
        observation_size: count of the observation's numbers.
        action_low: lower bounds of the action.
        action_high: upper bounds of the action.
        threshold: the gate `risk` activates the filter where λ is above this.
        threshold_source: how the threshold was set.
        multiplier_source: how λ came about.
        hysteresis: an open gate stays open while λ is above this share of the threshold.
        dwell: for how many control steps after that it still stays open.
        calibration: how threshold, hysteresis and dwell were chosen; None: they were not.
        novelty: where novelty.npz comes from; None: there is none.
        hazard_radius: radius of a hazard [m].
        robot: the robot's constants, name → number, as `system.Robot` names them; empty: the task's own.
        opset: version of the standard ONNX operators that both graphs use.
        sha256: file name → SHA-256 of the file, hexadecimal; `write_bundle` fills it in.
        training: the training's configuration.
        figures: name → number, for example the evaluation's return and cost.
        versions: package → version used for the export.
    """

    format_version: Literal[1] = FORMAT_VERSION
    name: Annotated[str, Field(pattern=f"^{NAME}$")]
    created: AwareDatetime
    task: Annotated[str, Field(min_length=1)]
    level: Annotated[int, Field(ge=0, le=2)]
    algorithm: Annotated[str, Field(min_length=1)]
    observation_layout: tuple[ObservationBlock, ...]
    observation_size: Positive
    action_low: Pair
    action_high: Pair
    threshold: Annotated[float, Field(ge=0.0)]
    threshold_source: Annotated[str, Field(min_length=1)]
    multiplier_source: str = ""
    hysteresis: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    dwell: Annotated[int, Field(ge=0, le=1000)] = 0
    calibration: Calibration | None = None
    novelty: NoveltySource | None = None
    hazard_radius: Annotated[float, Field(gt=0.0)]
    robot: dict[str, Annotated[int | float, Field(gt=0)]] = {}
    opset: Positive
    sha256: dict[Literal["policy.onnx", "multiplier.onnx", "novelty.npz"], Sha256] = {}
    training: dict[str, Any] = {}
    figures: dict[str, float] = {}
    versions: dict[str, str] = {}

    @field_validator("training")
    @classmethod
    def _training_is_json(cls, training: dict[str, Any]) -> dict[str, Any]:
        try:
            json.dumps(training, allow_nan=False)
        except TypeError as error:
            raise ValueError(f"must be plain JSON: {error}") from error
        return training

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        known = self.sha256.get("multiplier.onnx")
        if self.calibration is not None and known not in (None, self.calibration.multiplier):
            raise ValueError("calibration: it is for another multiplier.onnx")
        start, names = 0, set()
        for block in self.observation_layout:
            if block.start != start or block.name in names:
                raise ValueError(
                    f"observation_layout: block {block.name!r} overlaps, leaves a gap or stands twice"
                )
            names.add(block.name)
            start += block.size
        if start != self.observation_size:
            raise ValueError(
                f"observation_layout has {start} numbers, observation_size says {self.observation_size}"
            )
        if not all(low < high for low, high in zip(self.action_low, self.action_high, strict=True)):
            raise ValueError("action_low must be below action_high")
        return self

    def to_json(self) -> str:
        """The text of manifest.json."""
        fields = self.model_dump(mode="json", exclude_none=True)
        return json.dumps(fields, indent=2, allow_nan=False) + "\n"
