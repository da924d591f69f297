"""A robot's own logs: a gate chosen from them by the onset form, and whether a calibration still applies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from decision import MOST_OPEN
from evaluation.errors import CalibrateError
from evaluation.exchange import Exchangeability, fewest_episodes, silence
from evaluation.logs import Log, read_log
from filter import BarrierFilter, FilterConfig
from inference import Networks
from models import MOST_SCORES, Bundle, Calibration, Manifest, check_target, write_bundle
from monitor import Monitor
from pointgoal import seeds
from pointgoal.seeds import Use
from trainer.calibration import LEAD, calibrate, scores

if TYPE_CHECKING:
    from evaluation.calibrate import CalibrateConfig

FloatArray = NDArray[np.float64]
_ROWS = 10_000
"""Observations that the network is given at once."""


@dataclass(frozen=True)
class Checked:
    """What a check found.

    Attributes:
        test: after the last episode.
        episodes: in the logs.
        scored: the log and the number in it of each episode that has a score, in order.
    """

    test: Exchangeability
    episodes: int
    scored: list[tuple[Path, int]]

    @property
    def alarmed(self) -> tuple[Path, int] | None:
        """The episode in which the martingale reached its bound."""
        at = self.test.alarmed
        return None if at is None else self.scored[at - 1]


def calibrate_on_logs(config: CalibrateConfig) -> Manifest:
    """Chooses the threshold from recorded episodes without a filter, and writes it into the bundle.

    Raises:
        CalibrateError: names what is missing: a log that is not in order, too few violations, a λ that does
            not announce them. The bundle is as it was.
        BundleError, MonitorError: if the bundle cannot be used.
    """
    check_promise(config)
    check_gate(config)
    bundle = Bundle.load(config.bundle)
    check_target(config.bundle)
    logs = _read(config.log, bundle, costs=True)
    risks = [part for log in logs for part in _risks(bundle, log)]
    if np.ptp(np.concatenate(risks)) == 0.0:
        raise CalibrateError(
            f"no threshold: λ is {risks[0][0]:g} in every row, it tells no state from another"
        )
    found = calibrate(_columns(risks), _columns(_costs(logs)), config.miss_rate, config.confidence)
    if found.why_not is not None:
        raise CalibrateError(
            f"no threshold for --miss-rate {config.miss_rate:g} with --confidence {config.confidence:g}: "
            f"{found.why_not}"
        )
    kept, n = _silences(found.scores), len(found.scores)
    sample = seeds.generator(Use.GATE, 0).permutation(n)[:MOST_SCORES]
    calibration = Calibration(
        method="onset",
        miss_rate=config.miss_rate,
        confidence=config.confidence,
        episodes=len(risks),
        missed=found.missed,
        multiplier=bundle.manifest.sha256["multiplier.onnx"],
        scores=tuple(sorted(kept[sample].tolist())),
        violating=n,
        logs=tuple(log.sha256 for log in logs),
    )
    changes = {
        "threshold": found.value,
        "hysteresis": config.hysteresis,
        "dwell": config.dwell,
        "threshold_source": _source(calibration),
        "calibration": calibration,
    }
    manifest = bundle.manifest.model_copy(update=changes)
    return write_bundle(bundle.path, bundle.policy, bundle.multiplier, manifest, bundle.novelty).manifest


def check_logs(config: CalibrateConfig) -> Checked:
    """Tests whether the logged episodes are exchangeable with those that the gate was calibrated on.

    Raises:
        CalibrateError: if the bundle's calibration kept no scores, a log is not in order or was calibrated
            on, or there are too few episodes to tell anything.
        BundleError, MonitorError: if the bundle cannot be used.
    """
    check_promise(config)
    bundle = Bundle.load(config.bundle)
    calibration = bundle.manifest.calibration
    if calibration is None or calibration.scores is None:
        what = "was not calibrated" if calibration is None else "was calibrated before scores were kept"
        raise CalibrateError(f"{config.bundle}: {what}: nothing to compare with; calibrate it anew")
    onset = calibration.method == "onset"
    logs = _read(config.log, bundle, costs=onset)
    for log in logs:
        if log.sha256 in (calibration.logs or ()):
            raise CalibrateError(f"--log {log.path}: is one that the gate was calibrated on, no new one")
    names = [(log.path, name) for log in logs for name in log.names]
    found = _of_violations(bundle, logs) if onset else _of_the_loop(bundle, logs)
    scored = [(name, score) for name, score in zip(names, found, strict=True) if score is not None]
    doubt = 1.0 - config.confidence
    needed = fewest_episodes(doubt)
    if len(scored) < needed:
        which = "episodes with a violation" if onset else "episodes"
        raise CalibrateError(
            f"{len(scored)} {which} in the logs cannot tell whether the calibration still applies: with "
            f"--confidence {config.confidence:g} at least {needed} are needed"
        )
    test = Exchangeability(calibration.scores, doubt)
    for _, score in scored:
        test.add(score)
    return Checked(test, len(names), [name for name, _ in scored])


def check_promise(config: CalibrateConfig) -> None:
    """Refuses what promises nothing, or everything: CalibrateError names the flag."""
    for flag, value in (("--miss-rate", config.miss_rate), ("--confidence", config.confidence)):
        if not 0.0 < value < 1.0:
            raise CalibrateError(f"{flag} must be between 0 and 1, got {value}")


def check_gate(config: CalibrateConfig) -> None:
    """Refuses what no gate can remember: CalibrateError names the flag."""
    if not 0.0 < config.hysteresis <= 1.0:
        raise CalibrateError(f"--hysteresis must be above 0 and at most 1, got {config.hysteresis}")
    if not 0 <= config.dwell <= MOST_OPEN:
        raise CalibrateError(f"--dwell must be 0 to {MOST_OPEN}, got {config.dwell}")


def barrier_filter(monitor: Monitor) -> BarrierFilter:
    """A filter with the robot and the hazards of the monitor's bundle: it says where the barrier is low."""
    radius = monitor.bundle.manifest.hazard_radius
    return BarrierFilter(FilterConfig(hazard_radius=radius, robot=monitor.robot))


def _read(paths: Sequence[Path], bundle: Bundle, costs: bool) -> list[Log]:
    logs: list[Log] = []
    for path in paths:
        log = read_log(path, bundle.manifest.observation_size, costs)
        for other in logs:
            if log.sha256 == other.sha256:
                raise CalibrateError(
                    f"--log {path}: is the same as {other.path}: its episodes would count twice"
                )
        logs.append(log)
    return logs


def _risks(bundle: Bundle, log: Log) -> list[FloatArray]:
    """λ of the log's episodes."""
    networks = Networks(bundle)
    rows = range(0, len(log.observation), _ROWS)
    risk = np.concatenate([networks.run(log.observation[row : row + _ROWS])[1] for row in rows])
    sound = (risk >= 0.0) & np.isfinite(risk)
    if not sound.all():
        row = int(np.argmin(sound))
        raise CalibrateError(
            f"--log {log.path}: λ must be a number from 0 on, got {risk[row]:g} in row {row}"
        )
    return [risk[rows] for rows in log.episodes]


def _costs(logs: list[Log]) -> list[FloatArray]:
    return [log.cost[rows] for log in logs if log.cost is not None for rows in log.episodes]


def _columns(parts: list[FloatArray]) -> FloatArray:
    """Episodes side by side [T, E], NaN after their ends."""
    table = np.full((max(map(len, parts)), len(parts)), np.nan)
    for column, part in enumerate(parts):
        table[: len(part), column] = part
    return table


def _silences(smallest: FloatArray) -> FloatArray:
    """The scores, from the smallest λ of each episode: −∞, where λ could not speak in time, as 0."""
    return silence(np.maximum(smallest, 0.0)[None], np.ones((1, len(smallest)), np.bool_))


def _of_violations(bundle: Bundle, logs: list[Log]) -> list[float | None]:
    """The score of each episode with a violation, None of another."""
    risks = [part for log in logs for part in _risks(bundle, log)]
    alone = [scores(risk[:, None], cost[:, None]) for risk, cost in zip(risks, _costs(logs), strict=True)]
    return [float(_silences(one)[0]) if one.size else None for one in alone]


def _of_the_loop(bundle: Bundle, logs: list[Log]) -> list[float | None]:
    """The score of each episode of a robot that a gate watches."""
    robot_filter = barrier_filter(Monitor.load(bundle.path, "off"))
    found: list[float | None] = []
    for log in logs:
        for risk, rows in zip(_risks(bundle, log), log.episodes, strict=True):
            found.append(float(silence(risk, robot_filter.look(log.observation[rows]).low)))
    return found


def _source(c: Calibration) -> str:
    logs = len(c.logs or ())
    return (
        f"onset: λ was above it for {LEAD} s ahead of every violation in all but {c.missed} of {c.violating} "
        f"violating of {c.episodes} recorded episodes without a filter ({logs} log{'s' * (logs != 1)}); at "
        f"most {100 * c.miss_rate:.4g}% of violating ones are missed, confidence {100 * c.confidence:.4g}%, "
        "exact binomial"
    )
