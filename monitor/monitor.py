"""One observation in, one decision out: the only place that composes policy, gate and filter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter import (
    SAFE_ACTION,
    BarrierFilter,
    FilterConfig,
    FilterError,
    FilterMemory,
    FilterResult,
    Mode,
    Row,
)
from models import Bundle
from monitor.decision import Decision, DecisionBatch
from monitor.errors import MonitorError, NetworkError
from monitor.memory import fits, join, take
from monitor.networks import FloatArray, Networks
from pointgoal.observation import layout

Gate = Literal["risk", "always", "off"]
"""When the filter is active: where the risk score exceeds the threshold, always, never."""
GATES: tuple[Gate, ...] = get_args(Gate)

_FAULTS = (
    FilterError,
    NetworkError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    BufferError,
    ImportError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What a decision turns into the safe action. Not `Exception`: a fault nobody thought of must be seen, and
does not reach the robot as an action either."""
_ROUNDING = 1e-6
_LARGEST = float(np.finfo(np.float32).max)
_ROW_LABELS: dict[int, str | None] = {row: row.name.lower() for row in Row} | {Row.NONE: None}


class ActionFilter(Protocol):
    """What the monitor needs of a filter; `filter.BarrierFilter` is one."""

    def filter(
        self,
        observation: FloatArray,
        nominal_action: FloatArray,
        hazards: FloatArray | None = None,
        memory: FilterMemory | None = None,
        active: NDArray[np.bool_] | None = None,
    ) -> FilterResult:
        """Filters N robots' nominal actions."""


class Monitor:
    """Watches one policy: `decide` turns an observation into the action to send.

    It never fails open. Whatever goes wrong inside (a network gives NaN, the filter raises or answers
    nonsense, the observation has another length) ends in a backup manoeuvre or zero thrust, mode "fallback"
    and the reason; the nominal action is sent only if everything that should have looked at it did.

    Args:
        bundle: the checked bundle.
        networks: its networks.
        action_filter: the filter.
        gate: when the filter is active.
        threshold: λ above which the gate `risk` activates the filter; None takes the bundle's.

    Raises:
        MonitorError: for an unknown gate, a threshold that is not finite and ≥ 0, or a bundle whose
            observation layout is not the task's.
    """

    def __init__(
        self,
        bundle: Bundle,
        networks: Networks,
        action_filter: ActionFilter,
        gate: Gate = "risk",
        threshold: float | None = None,
    ) -> None:
        if gate not in GATES:
            raise MonitorError(f"gate must be one of {', '.join(GATES)}, got {gate!r}")
        self.threshold = bundle.manifest.threshold if threshold is None else float(threshold)
        if not (math.isfinite(self.threshold) and self.threshold >= 0.0):
            raise MonitorError(f"threshold must be finite and at least 0, got {self.threshold}")
        _check_layout(bundle)
        self.bundle = bundle
        self.gate: Gate = gate
        self._networks = networks
        self._filter = action_filter
        self._low = np.array(bundle.manifest.action_low, np.float64)
        self._high = np.array(bundle.manifest.action_high, np.float64)
        self._safe = np.clip(np.array(SAFE_ACTION, np.float64), self._low, self._high)

    @staticmethod
    def load(
        path: str | Path,
        gate: Gate = "risk",
        threshold: float | None = None,
        filter_config: FilterConfig | None = None,
    ) -> Monitor:
        """Loads a bundle and runs a few decisions, so that the first real one is not the slow one.

        Args:
            path: the bundle's folder.
            gate: when the filter is active.
            threshold: λ above which the gate `risk` activates the filter; None takes the bundle's.
            filter_config: the filter's settings; None takes the defaults, with the bundle's hazard radius.

        Raises:
            BundleError: if the bundle must not be used.
            MonitorError: as the constructor, or if the bundle cannot decide about a robot at rest.
        """
        bundle = Bundle.load(path)
        try:
            networks = Networks(bundle)
        except NetworkError as error:
            raise MonitorError(f"{bundle.path}: {error}") from error
        monitor = Monitor(bundle, networks, _filter_of(bundle, filter_config), gate, threshold)
        monitor._warm_up()
        return monitor

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: FilterMemory | None = None
    ) -> Decision:
        """Decides for one robot.

        Args:
            observation: [O], in the bundle's layout.
            hazards: [n, 2], centres of the hazards in the body frame [m], x ahead, y left; None decodes the
                lidar.
            memory: the `memory` of this robot's last decision, or None.

        Returns:
            The decision; a bad input or any fault inside gives mode "fallback" with the reason.
        """
        try:
            row = np.array(observation, dtype=np.float64)[None]
            given = None if hazards is None else _one_robots_hazards(hazards)
        except _FAULTS as error:
            return self._fallback(1, f"bad input: {error}")[0]
        if memory is not None and not fits(memory, 1):
            return self._fallback(1, "bad input: the memory is not that of one robot")[0]
        return self._decide_or_fall_back(row, given, memory)[0]

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: FilterMemory | None = None
    ) -> DecisionBatch:
        """Decides for N robots at once, with the results of N calls of `decide`.

        The risk score may differ in float32's last bit: onnxruntime rounds a row's softplus by its place.

        Args:
            observation: [N, O].
            hazards: [N, n, 2] in the body frame [m], rows of NaN stand for none; None decodes the lidar.
            memory: the `memory` of these robots' last decisions, or None.

        Raises:
            ValueError: if the observation is not an array [N, O] of numbers, for then N is unknown, or the
                hazards or the memory are not those of N robots. A fault in one robot's row gives that robot
                the fallback and leaves the others alone.
        """
        rows = np.array(observation, dtype=np.float64)
        if rows.ndim != 2:
            raise ValueError(
                f"observation must have shape [N, {self._networks.observation_size}], got {rows.shape}"
            )
        given = None if hazards is None else np.asarray(hazards, dtype=np.float64)
        if given is not None and (given.ndim != 3 or given.shape[::2] != (len(rows), 2)):
            raise ValueError(f"hazards must have shape [{len(rows)}, n, 2], got {given.shape}")
        if memory is not None and not fits(memory, len(rows)):
            raise ValueError(f"memory is not that of {len(rows)} robots")
        return self._decide_or_fall_back(rows, given, memory)

    def _decide_or_fall_back(
        self, observation: FloatArray, hazards: FloatArray | None, memory: FilterMemory | None
    ) -> DecisionBatch:
        try:
            return self._decide(observation, hazards, memory)
        except _FAULTS as error:
            if len(observation) <= 1:
                return self._fallback(len(observation), str(error) or type(error).__name__)
        # Something in one row spoils the batch: decide one by one, so that only its own robot gets the
        # fallback.
        return _stack(
            [
                self._decide_or_fall_back(
                    observation[i : i + 1],
                    None if hazards is None else hazards[i : i + 1],
                    None if memory is None else take(memory, i),
                )
                for i in range(len(observation))
            ]
        )

    def _decide(
        self, observation: FloatArray, hazards: FloatArray | None, memory: FilterMemory | None
    ) -> DecisionBatch:
        """Networks, gate, filter; raises on whatever cannot be told apart by robot."""
        self._check_observation(observation)
        nominal, risk = self._networks.run(observation)
        nominal, sound = self._bound(nominal)
        sound &= (risk >= 0.0) & (risk < np.inf)
        active = self._gate_opens(risk) | ~sound
        asked = np.where(sound[:, None], nominal, self._safe)
        result = self._filter.filter(observation, asked, hazards, memory, active)
        self._check_result(result, asked, active)
        reason = list(result.reason)
        for i in np.flatnonzero(~sound):
            reason[i] = f"the networks gave action {nominal[i].tolist()} and multiplier {risk[i]}"
        return DecisionBatch(
            action=result.action,
            nominal_action=nominal,
            risk=risk,
            threshold=self.threshold,
            mode=np.where(sound, result.mode, Mode.FALLBACK).astype(np.int8),
            barrier=result.barrier,
            hazard=result.hazard,
            row=[_ROW_LABELS[label] for label in result.row.tolist()],
            reason=reason,
            gate_open=active,
            memory=result.memory,
        )

    def _gate_opens(self, risk: FloatArray) -> NDArray[np.bool_]:
        if self.gate == "risk":
            return ~(risk <= self.threshold)  # so that NaN opens it
        return np.full(len(risk), self.gate == "always")

    def _bound(self, action: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Which actions [N, 2] are numbers within the bounds; those have float32's rounding clipped off.

        onnxruntime's tanh, for one, reaches 1.0000001.
        """
        clipped = np.minimum(np.maximum(action, self._low), self._high)
        sound: NDArray[np.bool_] = np.all(np.abs(action - clipped) <= _ROUNDING, axis=1)
        return np.where(sound[:, None], clipped, action), sound

    def _check_observation(self, observation: FloatArray) -> None:
        size = self._networks.observation_size
        if observation.ndim != 2 or observation.shape[1] != size:
            raise ValueError(f"observation must have {size} numbers, got shape {list(observation.shape[1:])}")
        good = np.abs(observation) <= _LARGEST  # NaN is not
        if not good.all():
            row, column = np.argwhere(~good)[0]
            raise ValueError(f"observation[{column}] is {observation[row, column]}")

    def _check_result(self, result: FilterResult, asked: FloatArray, active: NDArray[np.bool_]) -> None:
        """Trusts no filter: what it answers must be an action, and its mode must be true."""
        if result.action.shape != asked.shape or result.mode.shape != active.shape:
            raise ValueError(f"the filter gave action {result.action.shape} and mode {result.mode.shape}")
        if result.action.tobytes() == asked.tobytes():
            return
        if not ((result.action >= self._low) & (result.action <= self._high)).all():
            raise ValueError(f"the filter gave an action outside of its bounds: {result.action.tolist()}")
        changed = (result.action.view(np.int64) != asked.view(np.int64)).any(axis=1)
        if (changed & (result.mode == Mode.NOMINAL)).any():
            raise ValueError("the filter changed an action and called it nominal")
        if (changed & ~active).any():
            raise ValueError("the filter changed an action though its gate is closed")

    def _fallback(self, count: int, reason: str) -> DecisionBatch:
        """Zero thrust for all: no barrier falls while the robot coasts.

        The memory starts anew: what it planned was for another action than this one.
        """
        return DecisionBatch(
            action=np.tile(self._safe, (count, 1)),
            nominal_action=np.full((count, 2), np.nan),
            risk=np.full(count, np.nan),
            threshold=self.threshold,
            mode=np.full(count, Mode.FALLBACK, np.int8),
            barrier=np.full(count, np.nan),
            hazard=np.full(count, -1),
            row=[None] * count,
            reason=[reason] * count,
            gate_open=np.ones(count, np.bool_),
            memory=FilterMemory.empty(count),
        )

    def _warm_up(self) -> None:
        """Runs the networks and every part of the filter once, with and without given hazards.

        Raises:
            MonitorError: if not even a robot at rest, nothing near, can be decided about.
        """
        blocks = layout(self.bundle.manifest.level)
        at_rest = np.zeros(blocks.size)
        at_rest[blocks.slice("accelerometer")] = (0.0, 0.0, 9.81)
        at_rest[blocks.slice("magnetometer")] = (0.0, -0.5, 0.0)
        decision = self.decide(at_rest)
        if decision.reason is not None:
            raise MonitorError(f"{self.bundle.path}: cannot decide about a robot at rest: {decision.reason}")
        moving = at_rest.copy()
        moving[blocks.slice("velocimeter")] = (1.0, 0.0, 0.0)
        asked = np.clip([[1.0, 0.0]], self._low, self._high)
        for distance in (1.0, 0.7, 0.5, 0.3, 0.1):
            self._filter.filter(moving[None], asked, np.array([[[distance, 0.0]]]))
            self.decide(moving, [[distance, 0.0]])


def _filter_of(bundle: Bundle, config: FilterConfig | None) -> BarrierFilter:
    if config is not None:
        return BarrierFilter(config)
    try:
        return BarrierFilter(FilterConfig(hazard_radius=bundle.manifest.hazard_radius))
    except ValueError as error:
        raise MonitorError(f"{bundle.path}: no filter for it: {error}") from error


def _one_robots_hazards(hazards: ArrayLike) -> FloatArray:
    """Hazards [1, n, 2] from [n, 2] or nothing; no other shape is guessed at."""
    given = np.array(hazards, dtype=np.float64)
    if given.shape == (0,):
        return given.reshape(1, 0, 2)
    if given.ndim != 2 or given.shape[1] != 2:
        raise ValueError(f"hazards must have shape [n, 2], got {list(given.shape)}")
    return given[None]


def _check_layout(bundle: Bundle) -> None:
    stated = [block.model_dump() for block in bundle.manifest.observation_layout]
    if stated != layout(bundle.manifest.level).to_json():
        raise MonitorError(
            f"{bundle.path}: its observation layout is not that of level {bundle.manifest.level} of the task"
        )


def _stack(batches: list[DecisionBatch]) -> DecisionBatch:
    """Batches of one robot each, as one."""
    return DecisionBatch(
        action=np.concatenate([batch.action for batch in batches]),
        nominal_action=np.concatenate([batch.nominal_action for batch in batches]),
        risk=np.concatenate([batch.risk for batch in batches]),
        threshold=batches[0].threshold,
        mode=np.concatenate([batch.mode for batch in batches]),
        barrier=np.concatenate([batch.barrier for batch in batches]),
        hazard=np.concatenate([batch.hazard for batch in batches]),
        row=[batch.row[0] for batch in batches],
        reason=[batch.reason[0] for batch in batches],
        gate_open=np.concatenate([batch.gate_open for batch in batches]),
        memory=join([batch.memory for batch in batches]),
    )
