"""Exchanges as a service has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pointgoal.observation import layout
from recorder.channels import Scribe
from recorder.exchange import Exchange

LAYOUT = layout(1).to_json()


def reply_to(request: dict[str, Any], **changes: Any) -> dict[str, Any]:
    told = {
        "action": [0.5, -0.25],
        "nominal_action": [0.1, 0.2],
        "mode": "nominal",
        "origin": None,
        "certified": True,
        "barrier": 1.25,
        "hazard": None,
        "reason": None,
        "risk": 0.125,
        "threshold": 0.5,
        "novelty": 0.25,
        "suspect": None,
        "opened_by": None,
        "memory": "c2VhbGVk",
        "plan": [[0.5, 0.5]],
        "gate_open": False,
        "gate": "risk",
        "model": "tiny@0",
        "request": request.get("request", 0),
        "seconds": 0.001,
    }
    return told | changes


def exchange_of(number: int, port: int = 1, seconds: float = 0.0, **changes: Any) -> Exchange:
    """An exchange with an observation of its own."""
    rng = np.random.default_rng(number)
    request = {"observation": rng.normal(size=60).tolist(), "request": number}
    at = 1_700_000_000_000_000_000 + int(seconds * 1e9)
    reply = json.dumps(reply_to(request, **changes)).encode()
    return Exchange(number, at, at + 1000, ("127.0.0.1", port), 200, json.dumps(request).encode(), reply)


@pytest.fixture(scope="session")
def exchange() -> Callable[..., Exchange]:
    """`exchange_of`."""
    return exchange_of


@pytest.fixture(scope="session")
def reply() -> Callable[..., dict[str, Any]]:
    """`reply_to`."""
    return reply_to


@pytest.fixture(scope="session")
def observation_layout() -> list[dict[str, Any]]:
    return LAYOUT


@pytest.fixture
def scribe() -> Scribe:
    return Scribe(LAYOUT)


@pytest.fixture(scope="session")
def about() -> dict[str, Any]:
    """What decided, as the service tells it."""
    model = {"model": "tiny@0", "gate": "risk", "observation_layout": LAYOUT}
    return {
        "version": "0",
        "text": {"version": "0", "model": json.dumps(model), "filter": "{}"},
        "layout": LAYOUT,
    }
