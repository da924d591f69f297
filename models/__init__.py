"""The bundle: what export writes and the runtime reads (policy.onnx, multiplier.onnx, manifest.json)."""

from models.bundle import Bundle, check_target, write_bundle
from models.errors import BundleError
from models.manifest import MOST_SCORES, Calibration, Manifest, NoveltySource, ObservationBlock

__all__ = [
    "MOST_SCORES",
    "Bundle",
    "BundleError",
    "Calibration",
    "Manifest",
    "NoveltySource",
    "ObservationBlock",
    "check_target",
    "write_bundle",
]
