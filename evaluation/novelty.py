"""What is normal for a bundle's policy on its robot, from its own drives: `lagnet-calibrate --novelty`."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from command import progress_bar
from decision import MEMORY
from evaluation.errors import CalibrateError
from models import Bundle, Manifest, NoveltySource, check_target, write_bundle
from monitor import Monitor
from novelty import FLOORS, Normal, Watch, calibrate, learn
from pointgoal import seeds
from pointgoal.loop import SIDE_BY_SIDE, drive, groups, side_by_side
from pointgoal.observation import LIDAR_BINS, layout
from pointgoal.scene import STEP_SECONDS
from pointgoal.seeds import Use
from pointgoal.simulation import EPISODE_STEPS
from pointgoal.vector import PointGoalVectorEnv

if TYPE_CHECKING:
    from evaluation.calibrate import CalibrateConfig

FloatArray = NDArray[np.float64]

_EVERY = 10
"""Control steps between two observations that are learnt from."""
_NONE_SEEN = 3.0
"""No event in a time T: with 95 % confidence at most about 3 / T (-log 0.05)."""


@dataclass
class Seen:
    """What many drives looked like.

    Attributes:
        observations: every tenth of them.
        largest: (3, 7) the largest distances that a watch found.
        least: (3,) the least of the scans' strongest readings, for each lidar.
    """

    observations: list[FloatArray]
    largest: FloatArray
    least: FloatArray


def find_normal(config: CalibrateConfig, console: Console) -> Manifest:
    """Learns what is normal in the closed loop, finds the limits on other episodes, and writes both.

    Raises:
        CalibrateError: if there are too few episodes.
        BundleError, MonitorError: if the bundle cannot be used.
    """
    if config.episodes < 2 or config.seed < 0:
        raise CalibrateError("--episodes must be at least 2 and --seed at least 0")
    bundle = Bundle.load(config.bundle)
    check_target(config.bundle)
    monitor = Monitor.load(replace(bundle, novelty=None), guide=config.guide)
    learnt_from = config.episodes // 2
    rows = seeds.rows(Use.NOVELTY, config.seed, learnt_from + config.episodes)
    empty = learn(np.zeros((2, bundle.manifest.observation_size)))
    with progress_bar(console) as bar:
        job = bar.add_task("what is normal", total=len(rows))

        def go(which: list[int], normal: Normal) -> Seen:
            return look_around(monitor, normal, which, config.hazards, lambda n: bar.advance(job, n))

        normal = learn(np.concatenate(go(rows[:learnt_from], empty).observations))
        seen = go(rows[learnt_from:], normal)
    found = calibrate(normal, seen.largest, seen.least)
    hours = config.episodes * EPISODE_STEPS * STEP_SECONDS / 3600.0
    source = NoveltySource(
        episodes=learnt_from,
        limit_episodes=config.episodes,
        hours=hours,
        alarms_per_hour=_NONE_SEEN / hours,
        hazards=config.hazards,
        seed=config.seed,
    )
    manifest = bundle.manifest.model_copy(update={"novelty": source})
    written = write_bundle(bundle.path, bundle.policy, bundle.multiplier, manifest, found.to_bytes())
    return written.manifest


def look_around(
    monitor: Monitor, normal: Normal, rows: list[int], hazards: str, done: Any = lambda count: None
) -> Seen:
    """Drives one episode for each row, in the closed loop, and measures what is seen; no limit is applied."""
    unlimited = replace(normal, limits=np.full(FLOORS.shape, np.inf), least=np.zeros(3))
    watch = Watch(unlimited, monitor.robot)
    lidars = layout(monitor.bundle.manifest.level).slice("goal_lidar").start
    seen = Seen([], np.zeros(FLOORS.shape), np.ones(3))
    level, size = monitor.bundle.manifest.level, side_by_side(len(rows), SIDE_BY_SIDE)
    with closing(PointGoalVectorEnv(level=level, num_envs=size, num_threads=1)) as env:
        for part in groups(len(rows), size):
            memory = np.zeros(size, MEMORY)

            def act(observation: FloatArray, env: PointGoalVectorEnv) -> FloatArray:
                nonlocal memory
                found = watch.look(observation, memory)
                given = env.hazards_in_body_frame() if hazards == "given" else None
                decided = monitor.decide_batch(observation, given, memory)
                memory = decided.memory
                watch.remember(observation, found, memory)
                seen.largest = np.maximum(seen.largest, found.off.max(axis=0))
                return decided.action

            for t, step in enumerate(drive(env, act, rows[part])):
                if t % _EVERY == 0:
                    seen.observations.append(step.observation.copy())
                scans = step.observation[:, lidars:].reshape(size, -1, LIDAR_BINS).max(axis=2).min(axis=0)
                seen.least[: len(scans)] = np.minimum(seen.least[: len(scans)], scans)
            done(part.stop - part.start)
    return seen
