"""A service in this process and one as users start it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from monitor import Monitor
from server import create_app


@pytest.fixture(scope="session")
def monitor(tiny_bundle: Path) -> Monitor:
    """A monitor whose filter is always active."""
    return Monitor.load(tiny_bundle, "always")


@pytest.fixture
def app(monitor: Monitor) -> TestClient:
    """The service in this process; what it raises, the test sees."""
    return TestClient(create_app(monitor))


@pytest.fixture
def observation() -> list[float]:
    """An observation [60]."""
    return [float(value) for value in np.random.default_rng(5).uniform(0.0, 0.5, 60)]


def no_constant(name: str) -> Any:
    raise AssertionError(f"{name} is no JSON")


@pytest.fixture
def strict_json():
    """Reads JSON that has no NaN and no Infinity."""
    return lambda text: json.loads(text, parse_constant=no_constant)
