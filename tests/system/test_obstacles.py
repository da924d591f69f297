import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from system.obstacles import COLUMNS, FAR, gap, gap_segment, least_gap, put

places = st.floats(-2.0, 2.0)
cones = st.tuples(places, places, places, places, st.floats(0.05, 0.4), st.floats(-0.04, 0.6))


def rows(*cones):
    out = np.full((len(cones), COLUMNS), np.nan)
    for i, cone in enumerate(cones):
        put(out, i, *cone)
    return out


def brute(cone, points):
    """Distance from points (n, 2) to many of the discs that a cone is made of."""
    at = np.linspace(0.0, 1.0, 400)[:, None]
    centres = np.array(cone[:2]) + at * np.array(cone[2:4])
    radii = cone[4] + at[:, 0] * cone[5]
    return (np.linalg.norm(points[:, None] - centres[None], axis=2) - radii).min(axis=1)


@settings(deadline=None, max_examples=150)
@given(cone=cones, x=places, y=places)
@example(cone=(0.0, 0.0, 0.0, 0.0, 0.25, 0.5), x=0.0, y=0.0)
def test_gap_is_the_distance_to_the_nearest_disc(cone, x, y):
    expected = brute(cone, np.array([[x, y]]))[0]
    assert abs(gap(rows(cone), 0, x, y) - expected) < 0.01
    assert gap(rows(cone), 0, x, y) <= expected + 1e-9


@settings(deadline=None, max_examples=100)
@given(cone=cones, start=st.tuples(places, places), end=st.tuples(places, places))
@example(cone=(0.0, 1.0, 0.0, 0.0, 0.25, 0.0), start=(1.0, 0.0), end=(1.0, 1.9354341599762002e-07))
def test_gap_to_a_segment_is_the_least_on_its_way(cone, start, end):
    way = np.linspace(0.0, 1.0, 300)[:, None]
    expected = min(gap(rows(cone), 0, *point) for point in np.array(start) + way * np.subtract(end, start))
    found = gap_segment(rows(cone), 0, *start, *end, FAR)
    # Exact: below all that is met on the way, and no farther below than the way may miss between two points.
    assert found <= expected + 1e-9
    assert found >= expected - 0.51 * np.hypot(*np.subtract(end, start)) / 299


def test_hazard_is_found_exactly():
    disc = rows((1.0, 0.5, 0.0, 0.0, 0.2, 0.0))
    assert abs(gap_segment(disc, 0, 0.0, 0.0, 2.0, 0.0, FAR) - 0.3) < 1e-12


@settings(deadline=None, max_examples=60)
@given(
    some=st.lists(cones, min_size=1, max_size=6),
    start=st.tuples(places, places),
    end=st.tuples(places, places),
    first=st.integers(-1, 5),
)
def test_least_gap_is_the_least_of_all(some, start, end, first):
    obstacles = rows(*some)
    expected = [gap_segment(obstacles, i, *start, *end, FAR) for i in range(len(some))]
    found, nearest = least_gap(obstacles, len(some), *start, *end, first if first < len(some) else -1, -FAR)
    assert abs(found - min(expected)) < 1e-9
    assert expected[nearest] < min(expected) + 1e-9


def test_nothing_is_far():
    assert least_gap(np.empty((0, COLUMNS)), 0, 0.0, 0.0, 1.0, 0.0, -1, -FAR) == (FAR, -1)
