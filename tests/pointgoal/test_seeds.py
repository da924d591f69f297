"""No two uses of random numbers, no two seeds and no two rows share a stream."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.utils.seeding import np_random

from benchmarks import filter_closed_loop, simulation
from evaluation.closed_loop import run_episodes
from pointgoal import seeds
from pointgoal.seeds import Use
from pointgoal.vector import PointGoalVectorEnv
from trainer.config import Config
from trainer.export import play
from trainer.train import Run, make_environments

SEEDS = range(4)


def streams() -> Iterator[np.random.Generator]:
    """Every kind of stream that there is, of neighbouring seeds."""
    for seed in SEEDS:
        yield np_random(seed)[0]
        yield from (np_random(row)[0] for row in seeds.spawn(seed, 100))
        for use in Use:
            yield seeds.generator(use, seed)
            yield from (np_random(row)[0] for row in seeds.rows(use, seed, 100))


def test_no_stream_is_another_one() -> None:
    found = [generator.bit_generator.state["state"]["state"] for generator in streams()]
    assert len(set(found)) == len(found) == len(SEEDS) * (101 + len(Use) * 101)


def test_the_first_rows_stay_whatever_the_count() -> None:
    assert seeds.rows(Use.EVALUATION, 5, 3) == seeds.rows(Use.EVALUATION, 5, 200)[:3]
    assert seeds.spawn(5, 3) == seeds.spawn(5, 200)[:3]


def test_streams_stay_from_version_to_version() -> None:
    assert seeds.rows(Use.TRAINING, 1, 1) == [228386232056458876424321286355113594625]
    assert seeds.generator(Use.EVALUATION, 1).integers(2**63) == 168006682332950832


@pytest.mark.parametrize("make", [seeds.spawn, lambda seed, count: seeds.rows(Use.DEMO, seed, count)])
def test_a_negative_seed_is_refused(make) -> None:
    with pytest.raises(ValueError, match="non-negative"):
        make(-1, 2)


class Reset(Exception):
    """Ends what is run as soon as its environments have been reset."""


def run_of(seed: int) -> SimpleNamespace:
    learner = SimpleNamespace(features=lambda observation: observation)
    return SimpleNamespace(config=Config(seed=seed), learner=learner, act=None)


def train(seed: int) -> None:
    config = Config(seed=seed, threads=1)
    Run(config, None, make_environments(config))


FILTERED = filter_closed_loop.Line("random", "plain", "given", "none", "off")
USERS = {
    **{f"training {seed}": lambda seed=seed: train(seed) for seed in SEEDS},
    "calibration 0": lambda: play(run_of(0), 50, 1),
    "calibration 1": lambda: play(run_of(1), 50, 1),
    "comparison": lambda: play(run_of(0), 50, 1, use=Use.COMPARISON),
    "evaluation 0": lambda: run_episodes("PointGoal1-v0", None, 100),
    "evaluation 1": lambda: run_episodes("PointGoal1-v0", None, 100, 1),
    "demo": lambda: run_episodes("PointGoal1-v0", None, 20, use=Use.DEMO),
    "filter": lambda: filter_closed_loop.run(FILTERED, 100),
    "simulation": lambda: simulation.measure(1, 100, 1, simulation.Settings()),
    **{f"plain {seed}": lambda seed=seed: PointGoalVectorEnv(1, 80).reset(seed=seed) for seed in SEEDS},
}


def test_no_two_users_start_from_the_same_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    """What each of them really resets its environments to: trained, calibrated, evaluated and measured."""
    reset, starts = PointGoalVectorEnv.reset, []

    def recorded(self: PointGoalVectorEnv, **arguments: object) -> None:
        reset(self, **arguments)
        starts.append(np.hstack([self.pose, self.goal, self.hazards.reshape(self.num_envs, -1)]))
        raise Reset

    monkeypatch.setattr(PointGoalVectorEnv, "reset", recorded)
    for user in USERS.values():
        with pytest.raises(Reset):
            user()
    assert [len(start) for start in starts] == [80] * 4 + [50] * 3 + [100, 100, 20, 100, 100] + [80] * 4
    together = np.concatenate(starts)
    for numbers in (together[:, :2], together[:, 3:5], together[:, 5:]):  # robots, goals, hazards
        assert len(np.unique(numbers, axis=0)) == len(together)
