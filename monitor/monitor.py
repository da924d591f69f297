"""One observation in, one decision out: the only place that composes policy, gate and filter."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from decision import (
    MEMORY,
    SAFE_ACTION,
    Decision,
    Decisions,
    Faults,
    Memory,
    Mode,
    OpenedBy,
    Origin,
    Stopwatch,
    fall_back,
    hazards_of_one,
    in_parts,
    memory_of,
    next_of_plan,
    texts,
)
from filter import DOUBT, BarrierFilter, FilterConfig, FilterInputError, Robot, Scene
from guide import DEFAULT_STRENGTH, Guide, Strength
from inference import NetworkError, Networks
from inference.networks import FloatArray, within
from models import Bundle
from monitor.errors import MonitorError
from monitor.gate import BoolArray, Gate, GateName
from novelty import Findings, Normal, Watch, nothing
from pointgoal.observation import layout


class ActionFilter(Protocol):
    """What the monitor needs of a filter; `filter.BarrierFilter` is one."""

    def look(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Scene:
        """What N robots see."""

    def decide(self, scene: Scene, nominal: FloatArray, memory: Memory, active: BoolArray) -> Decisions:
        """Filters N robots' nominal actions."""


class Monitor:
    """Watches one policy: `decide` turns an observation into the action to send.

    It never fails open. Whatever goes wrong ends in mode "fallback" and the reason: the plan in the robot's
    memory goes on, then the robot coasts. The nominal action is sent only if all that should look at it did.

    Args:
        bundle: the checked bundle.
        networks: its networks.
        action_filter: the filter.
        gate: when the filter is active: its name, and the bundle says the rest; or all of it.
        threshold: λ above which the gate `risk` opens; None takes the bundle's, or that of a whole gate.
        guide: how much the filter's guide may do, to be told.
        watch: looks at what the sensors show; None: nobody does.

    Attributes:
        faults: what went wrong so far.
        robot: the constants of the bundle's robot.
        look: what N robots see, and nothing is decided; see `ActionFilter.look`.
        stopwatch: how long "inference" and "filter" took.

    Raises:
        MonitorError: for an unknown gate, a threshold that is not finite and >= 0 or stands beside a whole
            gate, or a bundle whose observation layout is not the task's.
    """

    def __init__(
        self,
        bundle: Bundle,
        networks: Networks,
        action_filter: ActionFilter,
        gate: GateName | Gate = "risk",
        threshold: float | None = None,
        guide: Strength = "off",
        watch: Watch | None = None,
    ) -> None:
        _check_layout(bundle)
        manifest = bundle.manifest
        self.bundle = bundle
        self.robot = _robot(bundle)
        self.guide: Strength = guide
        self.faults = Faults()
        self.stopwatch = Stopwatch()
        if isinstance(gate, Gate) and threshold is not None:
            raise MonitorError(f"threshold must be None beside a Gate, which has its own, got {threshold}")
        wanted = manifest.threshold if threshold is None else float(threshold)
        self.gate = Gate(gate, wanted, manifest.hysteresis, manifest.dwell) if isinstance(gate, str) else gate
        self._networks = networks
        self._filter, self.look = action_filter, action_filter.look
        self._watch = watch
        self._low = np.array(manifest.action_low, np.float64)
        self._high = np.array(manifest.action_high, np.float64)
        self._safe = np.clip(np.array(SAFE_ACTION, np.float64), self._low, self._high)

    @staticmethod
    def load(
        path: str | Path | Bundle,
        gate: GateName | Gate = "risk",
        threshold: float | None = None,
        filter_config: FilterConfig | None = None,
        guide: Strength = DEFAULT_STRENGTH,
    ) -> Monitor:
        """Loads a bundle and runs a few decisions, so that the first real one is not the slow one.

        Args:
            path: the bundle's folder, or a bundle that is loaded.
            gate: when the filter is active: its name, and the bundle says the rest; or all of it.
            threshold: λ above which the gate `risk` opens; None takes the bundle's, or that of a whole gate.
            filter_config: the filter's settings; None takes the defaults. The hazards' radius and the robot's
                constants are the bundle's where the settings leave them open.
            guide: how much the guide may do: off, from a refusal on, or ahead.

        Raises:
            BundleError: if the bundle must not be used.
            MonitorError: as the constructor, if the settings contradict the bundle, or it cannot decide.
        """
        bundle = path if isinstance(path, Bundle) else Bundle.load(path)
        try:
            config = _filter_config(bundle, filter_config or FilterConfig())
            action_filter = BarrierFilter(config, Guide(config, guide))
            networks = Networks(bundle)
            watch = _watch(bundle, config)
        except (NetworkError, ValueError) as error:
            raise MonitorError(f"{bundle.path}: {error}") from error
        # What a robot at rest nowhere in particular sees is novel: nobody watches that.
        Monitor(bundle, networks, action_filter, gate, threshold, guide)._warm_up()
        return Monitor(bundle, networks, action_filter, gate, threshold, guide, watch)

    def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """Decides for one robot.

        Args:
            observation: (O,), in the bundle's layout.
            hazards: (n, 2), centres of hazards in the body frame [m], x ahead, y left; None or none at all:
                what the lidar shows. Hazards that the lidar shows beside the given ones count as well.
            memory: the `memory` of this robot's last decision; None before its first.

        A bad input or any fault inside gives mode "fallback" with the reason.
        """
        return self.decide_lost(observation, hazards, memory, None)

    def decide_lost(
        self, observation: ArrayLike, hazards: ArrayLike | None, memory: Any, lost: str | None
    ) -> Decision:
        """`decide` for a robot whose memory is ``lost``, and why: then nothing nominal is sent."""
        try:
            past = memory_of(1, memory)
        except ValueError as error:
            past, lost = np.zeros(1, MEMORY), self._bad(error)
        try:
            row = np.array(observation, dtype=np.float64)[None]
            given = None if hazards is None else hazards_of_one(hazards)
        except (TypeError, ValueError) as error:
            return self.fall_back(past, self._bad(error))[0]
        return self._decide_or_fall_back(row, given, past, lost)[0]

    def decide_batch(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | None = None
    ) -> Decisions:
        """Decides for N robots at once, as N calls of `decide` would but for float32's last bit of the risk.

        Args:
            observation: (N, O).
            hazards: (N, n, 2) in the body frame [m], rows of NaN stand for none; None: the lidar alone.
            memory: the `memory` of these robots' last decisions, or None.

        Raises:
            ValueError: if the observation is not an array (N, O) of numbers, or the hazards or the memory are
                not those of N robots. A fault in one row gives that robot alone the fallback.
        """
        rows = np.array(observation, dtype=np.float64, order="C")
        if rows.ndim != 2:
            size = self._networks.observation_size
            raise ValueError(f"observation must have shape [N, {size}], got {rows.shape}")
        given = None if hazards is None else np.asarray(hazards, dtype=np.float64)
        if given is not None and (given.ndim != 3 or given.shape[::2] != (len(rows), 2)):
            raise ValueError(f"hazards must have shape [{len(rows)}, n, 2], got {given.shape}")
        return in_parts(self._decide_or_fall_back, rows, given, memory_of(len(rows), memory))

    def _decide_or_fall_back(
        self, observation: FloatArray, hazards: FloatArray | None, memory: Memory, lost: str | None = None
    ) -> Decisions:
        """Decides, whatever happens; ``lost`` as in `decide_lost`."""
        try:
            return self._decide(observation, hazards, memory, lost)
        except Exception as error:  # noqa: BLE001 - whatever it is, the robot needs an action
            if len(observation) <= 1:
                return self.fall_back(memory, self._note(error))
        # Something in one row spoils the batch: one by one, only its own robot gets the fallback.
        rows = [slice(i, i + 1) for i in range(len(observation))]
        alone = [(observation[i], None if hazards is None else hazards[i], memory[i]) for i in rows]
        return Decisions.join([self._decide_or_fall_back(*robot) for robot in alone])

    def fall_back(self, memory: Memory, reason: str) -> Decisions:
        """The fallback of N robots with this memory (N,): their plans, then the bundle's safe action."""
        return fall_back(memory, reason, self.gate.threshold, self._safe)

    def _decide(
        self, observation: FloatArray, hazards: FloatArray | None, memory: Memory, lost: str | None
    ) -> Decisions:
        """Networks, gate, filter; raises on whatever cannot be told apart by robot."""
        size = self._networks.observation_size
        if observation.shape[1:] != (size,):
            raise FilterInputError("observation", f"must have {size} numbers, got {observation.shape[1:]}")
        scene = self._filter.look(observation, hazards, memory)
        found = self._watch.look(observation, memory) if self._watch is not None else nothing(len(scene))
        acts = found.any and self.gate.name != "off"
        if acts:
            scene.doubt(found.doubted)
        nominal, risk = self.stopwatch("inference", self._networks.run, observation)
        if nominal.shape != (len(observation), 2) or risk.shape != nominal.shape[:1]:
            raise NetworkError(f"the networks gave shapes {nominal.shape} and {risk.shape}")
        sound = np.empty(len(risk), np.bool_)
        all_sound = within(nominal, self._low, self._high, risk, sound) and lost is None
        engaging = scene.low | (found.novelty > 1.0) if found.any else scene.low
        opened_by = self._opened_by(scene, found, risk, engaging, memory)
        asked = nominal
        if not all_sound:
            sound &= lost is None
            opened_by = np.where(sound, opened_by, texts(OpenedBy.FAULT, len(sound)))
            planned, after = next_of_plan(memory)
            # Where the scan is doubted as well, it is the filter that goes on with the plan.
            ahead = ~sound & ~scene.doubted
            asked, memory = np.where(sound[:, None], nominal, planned), np.where(ahead, after, memory)
        active = opened_by != ""
        decided = self.stopwatch("filter", self._filter.decide, scene, asked, memory, active)
        if decided.action is not asked or decided.mode.shape != active.shape:
            decided.check(asked, active, self._low, self._high)
        if acts:
            decided = _say_why(decided, found)
        if not all_sound:
            decided = self._planned(
                decided, [lost or self._wrong(*row) for row in zip(nominal, risk, sound, strict=True)]
            )
        self.gate.remember(risk, engaging, decided.changed, decided.memory)
        if self._watch is not None:
            self._watch.remember(observation, found, decided.memory)
        return decided.told(nominal, risk, self.gate.threshold, opened_by, found.novelty, found.suspect)

    def _opened_by(
        self, scene: Scene, found: Findings, risk: FloatArray, engaging: BoolArray, memory: Memory
    ) -> NDArray[np.str_]:
        """What opens the gate for N robots: its own causes, and those of doubt, which are noted."""
        opened_by = self.gate.opened_by(risk, engaging, memory)
        if found.any:
            for sensor in np.unique(found.suspect[found.suspect != ""]).tolist():
                self.faults.note(f"novelty: {sensor}", f"the {sensor} shows what it should not")
        if self.gate.name == "off":
            return opened_by
        if found.any:
            novel = found.doubted | (found.novelty > 1.0)
            opened_by = np.where(novel, texts(OpenedBy.NOVELTY, len(scene)), opened_by)
        if np.count_nonzero(scene.doubted):
            by_scan = scene.doubted & ~found.doubted
            opened_by = np.where(by_scan, texts(OpenedBy.FAULT, len(scene)), opened_by)
            if by_scan.any():
                self.faults.note("lidar", DOUBT)
        return opened_by

    def _wrong(self, nominal: FloatArray, risk: float, sound: np.bool_) -> str | None:
        """What is wrong with what the networks gave for a robot, noted; None if nothing is."""
        if sound:
            return None
        reason = f"the networks gave action {nominal.tolist()} and multiplier {risk}"
        self.faults.note("networks", reason)
        return reason

    def _planned(self, decided: Decisions, why: list[str | None]) -> Decisions:
        """Says of rows for which there is a reason that their plan was asked for, not a policy's action."""
        rows = np.array([reason is not None for reason in why])
        reason = [new or old for new, old in zip(why, decided.reason, strict=True)]
        return replace(
            decided,
            mode=np.where(rows, texts(Mode.FALLBACK, len(rows)), decided.mode),
            origin=np.where(rows & (decided.mode == Mode.NOMINAL), Origin.PLAN, decided.origin),
            reason=reason,
        )

    def _note(self, error: Exception) -> str:
        """Counts and logs what was caught; the reason for the decision."""
        if isinstance(error, FilterInputError):
            return self._bad(error)
        reason = str(error) or type(error).__name__
        self.faults.note(type(error).__name__, reason, error)
        return reason

    def _bad(self, error: Exception) -> str:
        self.faults.note("bad input", str(error))
        return f"bad input: {error}"

    def _warm_up(self) -> None:
        """Runs every part once, or raises MonitorError if not even a robot at rest can be decided about."""
        blocks = layout(self.bundle.manifest.level)
        at_rest = np.zeros((1, blocks.size))
        at_rest[:, blocks.slice("accelerometer")] = (0.0, 0.0, 9.81)
        at_rest[:, blocks.slice("magnetometer")] = (0.0, -0.5, 0.0)
        if (why := self.decide(at_rest[0]).reason) is not None:
            raise MonitorError(f"{self.bundle.path}: cannot decide about a robot at rest: {why}")
        asked = np.clip([[1.0, 0.0]], self._low, self._high)
        for speed, distance in product((1.0, 0.5, 0.0), (1.0, 0.7, 0.5, 0.3, 0.24, 0.22, 0.1)):
            at_rest[:, blocks.slice("velocimeter")] = (speed, 0.0, 0.0)
            scene = self._filter.look(at_rest, np.array([[[distance, 0.03]]]))
            self._filter.decide(scene, asked, np.zeros(1, MEMORY), np.ones(1, np.bool_))
            self.decide(at_rest[0], [[distance, 0.03]])


def _say_why(decided: Decisions, found: Findings) -> Decisions:
    """Names the sensor in the reasons of robots that stop because of it."""
    reason = list(decided.reason)
    for k in found.doubted.nonzero()[0]:
        who = f"the {found.suspect[k]} shows" if found.suspect[k] else "a sensor showed"
        reason[k] = (reason[k] or "").replace(DOUBT, f"{who} what it should not")
    return replace(decided, reason=reason)


def _watch(bundle: Bundle, config: FilterConfig) -> Watch | None:
    """Who looks at the sensors; None if the bundle does not say what is normal."""
    if bundle.novelty is None:
        return None
    normal = Normal.from_bytes(bundle.novelty, bundle.manifest.observation_size)
    watch = Watch(normal, config.robot or _robot(bundle), config.delay_steps)
    nobody, memory = np.zeros((1, bundle.manifest.observation_size)), np.zeros(1, MEMORY)
    watch.remember(nobody, watch.look(nobody, memory), memory)
    return watch


def _robot(bundle: Bundle) -> Robot:
    """The constants of the bundle's robot; the task's own where the manifest has none."""
    try:
        return Robot(**cast(dict[str, Any], bundle.manifest.robot))
    except TypeError as error:
        raise MonitorError(f"{bundle.path}: its robot: {error}") from error


def _filter_config(bundle: Bundle, config: FilterConfig) -> FilterConfig:
    """The settings, with the bundle's hazard radius and robot where they leave them open."""
    radius = bundle.manifest.hazard_radius
    if config.hazard_radius is not None and config.hazard_radius < radius:
        raise MonitorError(
            f"{bundle.path}: hazard_radius must be at least the bundle's {radius}, got {config.hazard_radius}"
        )
    return replace(
        config,
        hazard_radius=radius if config.hazard_radius is None else config.hazard_radius,
        robot=_robot(bundle) if config.robot is None else config.robot,
    )


def _check_layout(bundle: Bundle) -> None:
    stated = [block.model_dump() for block in bundle.manifest.observation_layout]
    if stated != layout(bundle.manifest.level).to_json():
        level = bundle.manifest.level
        raise MonitorError(f"{bundle.path}: its observation layout is not that of level {level} of the task")
