"""Sensors that fail, whether that is noticed, and what it costs: ``python -m benchmarks.sensors``.

In every episode one sensor begins to fail at some step and never recovers. Printed, and kept in a CSV file as
they come, are for each sensor and fault: the share of episodes in which it was noticed, the median time until
then, and violating steps with the gate `risk`, with `always`, and with `risk` if nobody watches the sensors.
"""

from __future__ import annotations

import logging
from collections import deque
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.record import keep, kept
from decision import MEMORY, Decisions
from models import Bundle
from monitor import GateName, Monitor
from novelty import GROUPS
from pointgoal import seeds
from pointgoal.loop import SIDE_BY_SIDE, drive, groups, side_by_side
from pointgoal.observation import layout
from pointgoal.scene import STEP_SECONDS
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv

FloatArray = NDArray[np.float64]
Fault = Literal["none", "zero", "frozen", "negated", "noise", "late"]
FAULTS: tuple[Fault, ...] = ("zero", "frozen", "negated", "noise", "late")
LATE = 3
"""Control steps by which a late sensor is late."""
ONSET = (50, 600)
"""Control steps between which the fault begins."""


@dataclass
class Arguments:
    """What to run."""

    bundle: Annotated[Path, tyro.conf.Positional] = Path("models/pointgoal1")
    """The bundle's folder; it has to say what is normal."""
    episodes: int = 1000
    """Episodes for each sensor, fault and gate."""
    hazards: Literal["lidar", "given"] = "lidar"
    """What the filter knows of the hazards."""
    seed: int = 0
    """Seed of the episodes' layouts and of the faults; tune on others."""
    sensors: tuple[str, ...] = GROUPS
    """Which sensors fail."""
    faults: tuple[Fault, ...] = FAULTS
    """How."""
    out: Path = Path("benchmarks/results/sensors.csv")
    """Where the lines are kept: those that are there already are not run again."""


@dataclass(frozen=True)
class Outcome:
    """What E episodes gave.

    Attributes:
        caught: (E,) steps from the fault's beginning until it was noticed; NaN: never.
        violations: (E,) violating steps.
        returns: (E,).
        early: alarms before the fault began.
    """

    caught: FloatArray
    violations: NDArray[np.int64]
    returns: FloatArray
    early: int


class Failing:
    """Puts a fault into one sensor of N robots, from a step of each robot's own on."""

    def __init__(
        self, sensor: str, fault: Fault, begins: NDArray[np.int64], rng: np.random.Generator
    ) -> None:
        self._where = layout(1).slice(sensor)
        self._fault = fault
        self._begins = begins
        self._rng = rng
        self._held: FloatArray | None = None
        self._past: deque[FloatArray] = deque(maxlen=LATE + 1)
        self._step = 0

    def __call__(self, observation: FloatArray) -> FloatArray:
        """The observations (N, 60) of the next step as the robots get them."""
        shown, now = observation.copy(), observation[:, self._where]
        self._past.append(now.copy())
        started = self._step >= self._begins
        if self._held is None:
            self._held = now.copy()
        self._held[~started] = now[~started]
        # As much noise as half of what this sensor's numbers differ by among the robots.
        noise = 0.5 * max(float(now.std()), 0.05) * self._rng.normal(size=now.shape)
        made = {
            "none": now,
            "zero": 0.0 * now,
            "frozen": self._held,
            "negated": -now,
            "noise": now + noise,
            "late": self._past[0],
        }[self._fault]
        shown[:, self._where] = np.where(started[:, None], made, now)
        self._step += 1
        return shown


def run(monitor: Monitor, sensor: str, fault: Fault, arguments: Arguments) -> Outcome:
    """Drives the episodes."""
    rows = seeds.rows(Use.SENSORS, arguments.seed, arguments.episodes)
    rng = seeds.generator(Use.SENSORS, arguments.seed)
    size = side_by_side(len(rows), SIDE_BY_SIDE)
    count = len(rows)
    caught, violations, returns = np.full(count, np.nan), np.zeros(count, np.int64), np.zeros(count)
    early = 0
    with closing(PointGoalVectorEnv(level=1, num_envs=size, num_threads=1)) as env:
        for part in groups(count, size):
            n = part.stop - part.start
            begins = rng.integers(*ONSET, size)
            failing = Failing(sensor, fault, begins, rng)
            memory = np.zeros(size, MEMORY)
            decided: Decisions | None = None

            def act(observation: FloatArray, env: Any, failing: Failing = failing) -> FloatArray:
                nonlocal memory, decided
                given = env.hazards_in_body_frame() if arguments.hazards == "given" else None
                decided = monitor.decide_batch(failing(observation), given, memory)
                memory = decided.memory
                return decided.action

            for t, step in enumerate(drive(env, act, rows[part])):
                assert decided is not None
                novel = decided.novelty[:n] > 1.0
                late = t - begins[:n]
                early += int((novel & (late < 0)).sum())
                first = novel & (late >= 0) & np.isnan(caught[part])
                caught[part] = np.where(first, late, caught[part])
                violations[part] += step.cost[:n] > 0.0
                returns[part] += step.reward[:n]
    return Outcome(caught, violations, returns, early)


def line(arguments: Arguments, sensor: str, fault: Fault) -> dict[str, str]:
    """One line of the table."""
    bundle = Bundle.load(arguments.bundle)
    told: dict[str, str] = {"sensor": sensor, "fault": fault, "hazards": arguments.hazards}
    told["episodes"] = str(arguments.episodes)
    gates: tuple[tuple[str, Bundle, GateName], ...] = (
        ("risk", bundle, "risk"),
        ("always", bundle, "always"),
        ("not watched", replace(bundle, novelty=None), "risk"),
    )
    for name, one, gate in gates:
        found = run(Monitor.load(one, gate), sensor, fault, arguments)
        if name == "risk":
            seen = found.caught[np.isfinite(found.caught)]
            told["caught"] = f"{len(seen) / arguments.episodes:.3f}"
            told["seconds"] = f"{STEP_SECONDS * (1 + np.median(seen)):.2f}" if len(seen) else ""
            told["early"] = str(found.early)
        told[f"{name}: violating steps"] = str(int(found.violations.sum()))
        told[f"{name}: episodes"] = str(int((found.violations > 0).sum()))
        told[f"{name}: return"] = f"{found.returns.mean():.1f}"
    return told


def main() -> None:
    """Run the lines that are not kept yet."""
    logging.getLogger("lagnet.monitor").setLevel(logging.ERROR)
    arguments = tyro.cli(Arguments)
    known = kept(arguments.out)
    for sensor in arguments.sensors:
        for fault in arguments.faults:
            asked = (sensor, fault, arguments.hazards, str(arguments.episodes))
            if any((row["sensor"], row["fault"], row["hazards"], row["episodes"]) == asked for row in known):
                continue
            row = line(arguments, sensor, fault)
            keep(arguments.out, row)
            print(" ".join(row.values()), flush=True)


if __name__ == "__main__":
    main()
