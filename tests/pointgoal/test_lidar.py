"""Where things are by what the lidar shows; what it shows of them is tested beside the simulation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointgoal.lidar import encode, nearest, places

distances = st.floats(0.01, 2.99)
bearings = st.floats(-10.0, 10.0)


def at(distance: float, bearing: float) -> np.ndarray:
    return distance * np.array([np.cos(bearing), np.sin(bearing)])


@given(distance=distances, bearing=bearings)
def test_a_thing_alone_is_where_it_is(distance: float, bearing: float) -> None:
    centre = at(distance, bearing)
    readings = encode(centre[None, None])
    x, y, away, seen = nearest(readings)
    assert [*x[0], *y[0]] == pytest.approx(centre.tolist(), abs=1e-5)
    assert (away[0, 0], seen[0, 0]) == (pytest.approx(distance, abs=1e-6), 1.0)


@given(things=st.lists(st.tuples(distances, bearings), min_size=1, max_size=5))
def test_of_many_the_nearest_ones_distance_is_shown(things: list[tuple[float, float]]) -> None:
    readings = encode(np.array([[at(*thing) for thing in things]]))
    assert nearest(readings)[2][0, 0] == pytest.approx(min(distance for distance, _ in things), abs=1e-6)


def test_a_row_is_a_lidar() -> None:
    centres = np.random.default_rng(0).uniform(-4, 4, (6, 3, 2))
    readings = encode(centres)
    assert readings.shape == (6, 16)
    for row, shown in zip(centres, readings, strict=True):
        np.testing.assert_array_equal(encode(row[None])[0], shown)
        np.testing.assert_array_equal(np.max([encode(one[None, None])[0] for one in row], axis=0), shown)


def test_beyond_the_range_nothing_is_seen() -> None:
    readings = encode(np.array([[[2.0, 2.5], [-3.0, 0.0]]]))
    assert not readings.any()
    assert nearest(readings)[2:] == (3.0, 0.0)
    np.testing.assert_allclose(places(readings)[2], 3.0)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_precision_stays(kind: type) -> None:
    readings = encode(np.array([[[1.0, 0.3]]])).astype(kind)
    assert {part.dtype for part in (*places(readings), *nearest(readings))} == {np.dtype(kind)}
