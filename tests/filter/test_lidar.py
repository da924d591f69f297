import numpy as np
from filter.lidar import CONES, decode, decode_goal, likeliest
from filter.obstacles import COLUMNS, gap
from hypothesis import given, settings
from hypothesis import strategies as st

RADIUS = 0.2
bearings = st.one_of(
    st.floats(-np.pi, np.pi),
    st.integers(0, 16).map(lambda b: b * np.pi / 8),
    st.integers(0, 16).map(lambda b: b * np.pi / 8 - 1e-17),
    st.integers(0, 16).map(lambda b: (b + 0.5) * np.pi / 8),
)
places = st.tuples(st.floats(0.0, 3.2), bearings).map(
    lambda polar: (polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]))
)
# Scattered, and crowded so that several share a bin or its neighbours.
crowds = st.tuples(st.floats(0.2, 2.5), st.floats(-np.pi, np.pi)).flatmap(
    lambda at: st.lists(
        st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)).map(
            lambda off: ((at[0] + off[0]) * np.cos(at[1] + off[1]), (at[0] + off[0]) * np.sin(at[1] + off[1]))
        ),
        min_size=1,
        max_size=6,
    )
)


def obstacles(readings, reach=1.6, spread=0.0):
    out = np.zeros((CONES, COLUMNS))
    source = np.zeros(CONES, dtype=np.int64)
    count = decode(readings, reach, RADIUS, spread, out, source)
    return out[:count], source[:count]


@settings(deadline=None, max_examples=300)
@given(hazards=st.one_of(st.lists(places, min_size=1, max_size=10), crowds))
def test_no_true_hazard_is_ever_nearer_than_what_was_decoded(hand, hazards):
    cones, _ = obstacles(hand.scan(np.array(hazards)))
    for x, y in hazards:
        if np.hypot(x, y) > 1.6:
            continue
        # Its whole disc lies in one obstacle, so it is nearer to nothing than that obstacle is.
        inside = min((gap(cones, i, x, y) for i in range(len(cones))), default=np.inf)
        assert inside <= -RADIUS + 1e-6


@settings(deadline=None, max_examples=60)
@given(hazards=st.lists(places, min_size=1, max_size=8), spread=st.floats(-0.03, 0.03))
def test_bearing_errors_are_covered(hand, hazards, spread):
    turned = [
        (np.cos(spread) * x - np.sin(spread) * y, np.sin(spread) * x + np.cos(spread) * y) for x, y in hazards
    ]
    cones, _ = obstacles(hand.scan(np.array(turned)), spread=0.03)
    for x, y in hazards:
        if np.hypot(x, y) <= 1.5:
            assert min((gap(cones, i, x, y) for i in range(len(cones))), default=np.inf) <= -RADIUS + 1e-6


@settings(deadline=None, max_examples=60)
@given(distance=st.floats(0.25, 1.4), bearing=st.floats(-np.pi, np.pi))
def test_a_hazard_alone_is_decoded_exactly(hand, distance, bearing):
    at = np.array([[distance * np.cos(bearing), distance * np.sin(bearing)]])
    cones, source = obstacles(hand.scan(at))
    nearest = min(gap(cones, i, 0.0, 0.0) for i in range(len(cones)))
    assert abs(nearest - (distance - RADIUS)) < 0.02
    # Nothing is in the way on the far side.
    assert min(gap(cones, i, -0.4 * np.cos(bearing), -0.4 * np.sin(bearing)) for i in range(len(cones))) > 0.3
    guess, labels = np.zeros((16, 3)), np.zeros(16, dtype=np.int64)
    assert likeliest(hand.scan(at), 0.3, guess, labels) >= 1
    assert np.linalg.norm(guess[:3, :2] - at, axis=1).min() < 1e-6
    assert set(source) <= {(int(np.remainder(bearing, 2 * np.pi) * 8 / np.pi) + i) % 16 for i in (-1, 0, 1)}


def test_out_of_range_is_nothing(hand):
    assert len(obstacles(hand.scan(np.array([[3.0, 0.5], [0.0, -3.4]])))[0]) == 0
    assert decode_goal(np.zeros(16)) == (False, 0.0, 0.0)


@settings(deadline=None, max_examples=60)
@given(distance=st.floats(0.01, 2.99), bearing=st.floats(-np.pi, np.pi))
def test_goal_is_exact(hand, distance, bearing):
    at = distance * np.cos(bearing), distance * np.sin(bearing)
    seen, x, y = decode_goal(hand.scan(np.array([at])))
    assert seen
    np.testing.assert_allclose((x, y), at, atol=1e-6)
