"""A monitor that runs, and parts to break one with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from filter import BarrierFilter, FilterMemory, FilterResult
from models import Bundle
from monitor import Gate, Monitor
from monitor.networks import Networks


class ScriptedNetworks(Networks):
    """Networks whose answers a test sets."""

    def __init__(self, action: object, risk: object) -> None:
        self.observation_size = 60
        self.action = np.asarray(action, dtype=np.float64)
        self.risk = np.asarray(risk, dtype=np.float64)

    def run(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.action.copy(), self.risk.copy()


class ScriptedFilter(BarrierFilter):
    """A filter that does what a test says, after asking the real one."""

    def __init__(self, fault: BaseException | None = None, **changes: object) -> None:
        super().__init__()
        self.fault = fault
        self.changes = changes

    def filter(self, observation, nominal_action, hazards=None, memory=None, active=None) -> FilterResult:
        if self.fault is not None:
            raise self.fault
        result = super().filter(observation, nominal_action, hazards, memory, active)
        fields = {name: getattr(result, name) for name in FilterResult.__dataclass_fields__}
        return FilterResult(**(fields | self.changes))


@pytest.fixture(scope="session")
def monitors(tiny_bundle: Path) -> dict[Gate, Monitor]:
    """A monitor for each gate."""
    return {gate: Monitor.load(tiny_bundle, gate) for gate in ("risk", "always", "off")}


@pytest.fixture
def build(tiny_bundle: Path):
    """Builds a monitor from the real parts, or from those given."""
    bundle = Bundle.load(tiny_bundle)

    def builder(networks=None, action_filter=None, gate="always", threshold=None) -> Monitor:
        return Monitor(
            bundle, networks or Networks(bundle), action_filter or BarrierFilter(), gate, threshold
        )

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
def no_memory() -> FilterMemory:
    """The memory of one robot before its first step."""
    return FilterMemory.empty(1)
