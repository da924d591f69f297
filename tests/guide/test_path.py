"""The way round: shortest, free, and on the side that was chosen."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from guide.path import first_hit, shortest_path, tangent

places = st.tuples(st.floats(0.5, 2.5), st.floats(-1.2, 1.2))


def discs(*rows):
    return np.array(rows, dtype=float).reshape(-1, 3)


def test_a_free_way_is_straight():
    way = shortest_path(discs(), 0, (2.0, 0.5), (0.0, 0.0), 0, 0.5)
    assert (way.x, way.y, way.blocker, way.side) == (2.0, 0.5, -1, 0)
    aside = discs((1.0, 0.8, 0.3))
    assert shortest_path(aside, 1, (2.0, 0.0), (0.0, 0.0), 0, 0.5).blocker == -1


def test_it_passes_on_the_shorter_side_unless_another_was_chosen():
    for off in (0.1, -0.1):
        one = discs((1.0, off, 0.3))
        shorter = -1 if off > 0 else 1
        way = shortest_path(one, 1, (2.0, 0.0), (0.0, 0.0), 0, 0.5)
        assert (way.blocker, way.side) == (0, shorter)
        assert np.sign(way.y - off) == shorter
        assert abs(way.distance - (1.0 - np.sqrt(0.09 - 0.01))) < 1e-9
        kept = shortest_path(one, 1, (2.0, 0.0), (0.0, 0.0), -shorter, 0.5)
        assert kept.side == -shorter


@settings(deadline=None, max_examples=100)
@given(
    x=st.floats(0.6, 2.0), y=st.floats(-0.8, 0.8), radius=st.floats(0.1, 0.45), side=st.sampled_from([1, -1])
)
def test_the_line_to_a_tangent_point_touches_the_disc(x, y, radius, side):
    one = discs((x, y, radius))
    tx, ty = tangent(one, 0, 0.0, 0.0, side)
    cross = (tx * y - ty * x) / np.hypot(tx, ty)
    assert abs(abs(cross) - radius) < 1e-9
    assert np.sign(-cross) == side  # it leaves the disc to its other hand


@settings(deadline=None, max_examples=200)
@given(some=st.lists(st.tuples(places, st.floats(0.1, 0.35)), min_size=1, max_size=8))
def test_the_first_leg_of_a_way_that_was_found_is_free(some):
    all_discs = discs(*[(x, y, r) for (x, y), r in some])
    way = shortest_path(all_discs, len(all_discs), (3.0, 0.0), (0.0, 0.0), 0, 0.5)
    hit, _ = first_hit(all_discs, len(all_discs), 0.0, 0.0, 3.0, 0.0, -1)
    assert way.blocker == hit
    if way.side != 0:
        # It may graze the disc that it goes past.
        shrunk = all_discs * (1.0, 1.0, 0.99)
        outside = np.hypot(all_discs[:, 0], all_discs[:, 1]) > all_discs[:, 2] * 1.02
        if outside.all():
            assert first_hit(shrunk, len(shrunk), 0.0, 0.0, way.x, way.y, -1)[0] < 0


@settings(deadline=None, max_examples=100)
@given(
    some=st.lists(st.tuples(places, st.floats(0.05, 0.4)), max_size=5),
    x=st.floats(0.2, 3.0),
    y=st.floats(-1, 1),
)
def test_the_first_hit_is_the_first_of_all(some, x, y):
    all_discs = discs(*[(cx, cy, r) for (cx, cy), r in some])
    hit, at = first_hit(all_discs, len(all_discs), 0.0, 0.0, x, y, -1)
    way = np.linspace(0.0, 1.0, 2000)[:, None] * (x, y)
    inside = np.zeros((2000, 0), bool)
    if len(all_discs):
        inside = np.linalg.norm(way[:, None] - all_discs[None, :, :2], axis=2) < all_discs[:, 2] * 0.995
    if inside.any() and np.hypot(all_discs[:, 0], all_discs[:, 1]).min(initial=9) > 0.45:
        first = np.linalg.norm(way[inside.any(axis=1).argmax()])
        assert hit >= 0
        assert at <= first + 1e-9
        assert (
            abs(
                np.linalg.norm(np.array([x, y]) / np.hypot(x, y) * at - all_discs[hit, :2])
                - all_discs[hit, 2]
            )
            < 1e-9
        )
