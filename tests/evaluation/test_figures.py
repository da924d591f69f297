"""The paper's figures 5 and 6: the episode that they show, and the moments that are starred."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from evaluation.figures import Episode, choose, play, write_figures
from models import Bundle
from pointgoal import seeds
from pointgoal.seeds import Use


@pytest.fixture(scope="module")
def shipped() -> Bundle:
    return Bundle.load(Path(__file__).parents[2] / "models" / "pointgoal1")


def test_the_stars_are_where_the_multiplier_is_largest_and_smallest() -> None:
    episode = Episode(1, np.zeros(4), np.zeros(4), np.array([0.2, 0.9, 0.1, 0.5]))
    assert (episode.peak, episode.safe) == (1, 2)


def test_it_shows_an_episode_with_a_violation_and_its_two_moments(shipped: Bundle, tmp_path: Path) -> None:
    episode = write_figures(shipped, 0, tmp_path / "new")
    assert episode.layout in seeds.rows(Use.EVALUATION, 0, 50)
    assert (episode.cost > 0.0).any()
    rows = list(csv.DictReader((tmp_path / "new" / "figure5.csv").open()))
    assert len(rows) == len(episode.cost) == 1000
    np.testing.assert_array_equal([float(row["multiplier"]) for row in rows], episode.risk)
    np.testing.assert_array_equal([float(row["cost"]) for row in rows], episode.cost)
    for name, ratio in (("figure5.png", 9.0 / 5.2), ("figure6.png", 8.0 / 4.5)):
        picture = imread(tmp_path / "new" / name)
        assert picture.shape[1] / picture.shape[0] == pytest.approx(ratio, rel=0.01)
        assert picture[..., :3].std() > 0.05


def test_the_pictures_are_of_the_moments_asked_for(shipped: Bundle) -> None:
    layout = choose(shipped, 0).layout
    _, (first, last, again) = play(shipped, layout, [0, 999, 0])
    np.testing.assert_array_equal(first, again)
    assert (first != last).any()
