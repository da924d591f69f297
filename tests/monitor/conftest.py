"""A monitor that runs, and parts to break one with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from decision import MEMORY, Decisions
from filter import BarrierFilter
from guide import Guide
from inference import Networks
from models import Bundle
from monitor import GateName, Monitor


class ScriptedNetworks(Networks):
    """Networks whose answers a test sets: arrays, or functions of the observation; one row goes for all."""

    def __init__(self, action: object, risk: object = (0.0,)) -> None:
        self.observation_size = 60
        self.action = action
        self.risk = risk

    def run(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        action, risk = (
            np.array(part(observation) if callable(part) else part, dtype=np.float64)
            for part in (self.action, self.risk)
        )
        n = len(observation)
        if n > 1 and action.shape == (1, 2):
            action = np.repeat(action, n, axis=0)
        if n > 1 and risk.shape == (1,):
            risk = np.repeat(risk, n)
        return action, risk


class ScriptedFilter(BarrierFilter):
    """A filter that does what a test says, after asking the real one.

    Attributes:
        fault: what it raises, or None.
        where: whether "look" or "decide" raises it.
        spoilt: raise only if a row of the observation has this velocity ahead; None: always.
        changes: fields of what `decide` answers.
    """

    def __init__(self, fault: BaseException | None = None, where: str = "decide", **changes: object) -> None:
        super().__init__()
        self.fault = fault
        self.where = where
        self.spoilt: float | None = None
        self.changes = changes

    def look(self, observation, hazards=None, memory=None):
        self._raise("look", np.asarray(observation)[:, 3])
        return super().look(observation, hazards)

    def decide(self, scene, nominal, memory, active) -> Decisions:
        self._raise("decide", scene.seen["vx"])
        return replace(super().decide(scene, nominal, memory, active), **self.changes)

    def _raise(self, where: str, ahead: np.ndarray) -> None:
        if (
            self.fault is not None
            and self.where == where
            and (self.spoilt is None or (ahead == self.spoilt).any())
        ):
            raise self.fault


@pytest.fixture(scope="session")
def monitors(tiny_bundle: Path) -> dict[GateName, Monitor]:
    """A monitor for each gate."""
    return {gate: Monitor.load(tiny_bundle, gate) for gate in ("risk", "always", "off")}


@pytest.fixture
def build(tiny_bundle: Path) -> Callable[..., Monitor]:
    """Builds a monitor from the real parts, or from those given; the filter has a guide.

    What else is named is what the bundle's manifest states.
    """
    bundle = Bundle.load(tiny_bundle)

    def builder(networks=None, action_filter=None, gate="always", threshold=None, **stated) -> Monitor:
        own = action_filter or BarrierFilter(guide=Guide())
        told = replace(bundle, manifest=bundle.manifest.model_copy(update=stated))
        return Monitor(told, networks or Networks(bundle), own, gate, threshold)

    builder.networks = ScriptedNetworks
    builder.filter = ScriptedFilter
    return builder


@pytest.fixture
def at_rest() -> np.ndarray:
    """The observation [60] of a robot at rest with nothing near."""
    observation = np.zeros(60)
    observation[2] = 9.81
    observation[10] = -0.5
    return observation


@pytest.fixture
def no_memory() -> np.ndarray:
    """The memory of one robot before its first step."""
    return np.zeros(1, MEMORY)
