"""The exceptions of this room."""

from __future__ import annotations


class EvaluateError(ValueError):
    """An evaluation or a demo that cannot be run as asked."""


class ServiceError(RuntimeError):
    """A service that did not start, or cannot be used."""


class ServiceGoneError(RuntimeError):
    """A service that stopped answering while robots were driving: what they did then is no evaluation."""


class CalibrateError(ValueError):
    """A calibration that cannot be done as asked, or in which no gate did what was asked."""
