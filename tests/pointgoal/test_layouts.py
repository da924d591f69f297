"""Layouts: keep-outs, extents, and the statistics of plain rejection sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp, kstest

from pointgoal import layouts
from pointgoal.layouts import EXTENT, GOAL_KEEPOUT, keepouts, sample_goal, sample_layout


@given(seed=st.integers(0, 2**32 - 1), level=st.sampled_from([0, 1, 2]))
@settings(max_examples=60, deadline=None)
def test_everything_keeps_its_distance_and_stays_inside(seed: int, level: int) -> None:
    drawn = sample_layout(np.random.default_rng(seed), level)
    places = np.vstack([drawn.pose[None, :2], drawn.hazards, drawn.vases, drawn.goal[None]])
    clear = np.append(keepouts(level), GOAL_KEEPOUT)
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    needed = clear[:, None] + clear[None]
    pairs = np.triu_indices(len(places), 1)
    assert (distance[pairs] >= needed[pairs]).all()
    assert (np.abs(places) <= EXTENT[level] - clear[:, None]).all()
    assert 0 <= drawn.pose[2] < 2 * np.pi


def plain_layout(rng: np.random.Generator, level: int) -> np.ndarray:
    """The reference's procedure, one draw at a time: robot, goal, hazards, vases; then the goal once more."""
    order = np.insert(keepouts(level), 1, GOAL_KEEPOUT)
    while True:
        placed: list[np.ndarray] = []
        for i, keepout in enumerate(order):
            for _ in range(100):
                place = rng.uniform(-EXTENT[level] + keepout, EXTENT[level] - keepout, 2)
                if all(np.linalg.norm(place - p) >= keepout + order[j] for j, p in enumerate(placed)):
                    placed.append(place)
                    break
            if len(placed) <= i:
                break
        else:
            others = placed[:1] + placed[2:]
            while True:
                reach = EXTENT[level] - GOAL_KEEPOUT
                goal = rng.uniform(-reach, reach, 2)
                if all(
                    np.linalg.norm(goal - p) >= GOAL_KEEPOUT + k
                    for p, k in zip(others, keepouts(level), strict=True)
                ):
                    return np.array([others[0], goal, *others[1:]])


def test_distances_follow_the_reference_procedure() -> None:
    rng = np.random.default_rng(1)
    reference = np.array([plain_layout(rng, 1) for _ in range(500)])
    rng = np.random.default_rng(2)
    drawn = [sample_layout(rng, 1) for _ in range(2500)]
    ours = np.array([[d.pose[:2], d.goal, *d.hazards, *d.vases] for d in drawn])
    for name, statistic in {
        "robot to goal": lambda p: np.linalg.norm(p[:, 0] - p[:, 1], axis=1),
        "robot to nearest hazard": lambda p: np.linalg.norm(p[:, 2:10] - p[:, :1], axis=2).min(axis=1),
        "robot from the centre": lambda p: np.linalg.norm(p[:, 0], axis=1),
        "last hazard from the centre": lambda p: np.linalg.norm(p[:, 9], axis=1),
        "goal from the centre": lambda p: np.linalg.norm(p[:, 1], axis=1),
    }.items():
        assert ks_2samp(statistic(ours), statistic(reference)).pvalue > 1e-3, name
    headings = [d.pose[2] / (2 * np.pi) for d in drawn]
    assert kstest(headings, "uniform").pvalue > 1e-3
    yaws = [d.vase_yaws[0] / (2 * np.pi) for d in drawn]
    assert kstest(yaws, "uniform").pvalue > 1e-3


def test_a_goal_without_a_place_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    others = np.full((10, 2), 5.0)
    assert sample_goal(np.random.default_rng(0), 1, others) is not None
    # All of what remains of the extents is nearer to a robot in the centre than the two keep-outs allow.
    monkeypatch.setitem(layouts.EXTENT, 1, 0.6)
    others[0] = 0.0
    assert sample_goal(np.random.default_rng(0), 1, others) is None


def test_an_impossible_layout_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(layouts.EXTENT, 1, 0.5)
    monkeypatch.setattr(layouts, "_LAYOUT_TRIES", 5)
    with pytest.raises(layouts.LayoutError, match="level 1"):
        sample_layout(np.random.default_rng(0), 1)
