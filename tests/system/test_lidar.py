import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from system.lidar import CONES, contradictory, decode, decode_goal, likeliest, unexplained
from system.obstacles import COLUMNS, gap

RADIUS = 0.2
ALL = np.ones(16, dtype=bool)
NONE = np.empty((0, 2))
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
    count = decode(readings, ALL, reach, RADIUS, spread, out, source, 0, 0)
    return out[:count], source[:count]


@settings(deadline=None, max_examples=300)
@example(hazards=[(1.6, 0.0)])
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
    assert likeliest(hand.scan(at), ALL, 0.3, guess, labels, 0, 0) >= 1
    assert np.linalg.norm(guess[:3, :2] - at, axis=1).min() < 1e-6
    assert set(source) <= {(int(np.remainder(bearing, 2 * np.pi) * 8 / np.pi) + i) % 16 for i in (-1, 0, 1)}


@settings(deadline=None, max_examples=300)
@given(hazards=st.one_of(st.lists(places, max_size=10), crowds))
def test_no_true_scan_contradicts_itself(hand, hazards):
    readings = hand.scan(np.array(hazards).reshape(-1, 2))
    assert not contradictory(readings, 1e-9)
    # Nor does one in single precision.
    assert not contradictory(readings.astype(np.float32).astype(np.float64), 1e-6)


@settings(deadline=None, max_examples=300)
@given(
    distance=st.floats(0.0, 2.5), bearing=bearings, which=st.sampled_from([-1, 0, 1]), share=st.floats(0, 0.9)
)
def test_a_hazard_alone_whose_bin_or_neighbour_is_weakened_is_a_contradiction(
    hand, distance, bearing, which, share
):
    at = np.array([[distance * np.cos(bearing), distance * np.sin(bearing)]])
    readings = hand.scan(at)
    top = int(readings.argmax())
    changed = readings.copy()
    changed[(top + which) % 16] *= share
    lost = readings - changed
    # Its own reading may fall to the larger of its neighbours' before they contradict it.
    beside = max(readings[(top - 1) % 16], readings[(top + 1) % 16])
    if which == 0:
        assume(changed[top] < beside - 1e-2)
    else:
        assume(lost.max() > 1e-2)
    assert contradictory(changed, 1e-3)


@pytest.mark.parametrize("value", [-0.01, 1.01, 7.0, -np.inf, np.inf, np.nan])
def test_a_reading_outside_of_the_range_is_a_contradiction(value):
    readings = np.full(16, 0.6)
    assert not contradictory(readings, 1e-3)
    readings[5] = value
    assert contradictory(readings, 1e-3)


@settings(deadline=None, max_examples=200)
@given(
    distance=st.floats(0.3, 1.4),
    bearing=bearings,
    errors=st.lists(st.floats(-0.02, 0.02), min_size=16, max_size=16),
)
def test_readings_that_are_a_little_off_drop_no_hazard(hand, distance, bearing, errors):
    """Within a tolerance the places of a hazard grow; they never become none."""
    at = np.array([distance * np.cos(bearing), distance * np.sin(bearing)])
    readings = hand.scan(at[None])
    readings = np.where(readings > 0.02, np.clip(readings + errors, 0.0, 1.0), readings)
    cones, _ = obstacles(readings)
    # 0.02 of the range is 6 cm; the neighbours' shares move the bearing by at most three of them.
    off = 0.06 + 0.06 * np.pi / 8 * distance / max(readings.max(), 0.5)
    assert min((gap(cones, i, *at) for i in range(len(cones))), default=np.inf) <= off - RADIUS


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


@settings(deadline=None, max_examples=100)
@given(hazards=st.one_of(st.lists(places, min_size=1, max_size=10), crowds))
def test_the_given_hazards_account_for_their_own_scan(hand, hazards):
    at = np.array(hazards)
    assert not unexplained(hand.scan(at), at, 0.0, 0.0).any()
    absent = np.vstack([np.full((1, 2), np.nan), at])
    assert not unexplained(hand.scan(at), absent, 0.0, 0.0).any()


@settings(deadline=None, max_examples=100)
@given(
    hazards=st.lists(places, min_size=1, max_size=6),
    off=st.floats(-0.02, 0.02),
    turned=st.floats(-0.03, 0.03),
)
def test_within_the_bounds_of_the_errors_given_hazards_still_account_for_it(hand, hazards, off, turned):
    assume(all(np.hypot(*place) > 0.05 for place in hazards))
    polar = [(np.hypot(x, y) + off, np.arctan2(y, x) + turned) for x, y in hazards]
    measured = np.array([(max(d, 0.0) * np.cos(b), max(d, 0.0) * np.sin(b)) for d, b in polar])
    assert not unexplained(hand.scan(np.array(hazards)), measured, 0.02, 0.03).any()


@settings(deadline=None, max_examples=100)
@given(
    known=st.lists(places, max_size=6),
    distance=st.floats(0.05, 1.4),
    bearing=st.floats(-np.pi, np.pi),
)
def test_a_hazard_that_is_not_given_is_covered_unless_a_given_one_hides_it(hand, known, distance, bearing):
    extra = np.array([[distance * np.cos(bearing), distance * np.sin(bearing)]])
    at = np.array(known).reshape(-1, 2)
    readings = hand.scan(np.vstack([at, extra]))
    wanted = unexplained(readings, at, 0.0, 0.0)
    own = int(np.remainder(bearing, 2 * np.pi) * 8 / np.pi) % 16
    if not wanted[own]:
        # It is behind one that is given: the scan would be the same without it.
        assert hand.scan(at)[own] >= hand.scan(extra)[own] - 1e-3
        return
    out, source = np.zeros((CONES, COLUMNS)), np.zeros(CONES, dtype=np.int64)
    count = decode(readings, wanted, 1.6, RADIUS, 0.0, out, source, 0, len(at))
    assert min(gap(out, i, *extra[0]) for i in range(count)) <= -RADIUS + 1e-6
    assert (source[:count] >= len(at)).all()


def test_what_was_there_already_stays_in_front(hand):
    readings = hand.scan(np.array([[0.6, 0.1]]))
    out, source = np.full((CONES + 2, COLUMNS), 7.0), np.full(CONES + 2, -5)
    count = decode(readings, ALL, 1.6, RADIUS, 0.0, out, source, 2, 100)
    assert count > 2
    assert (out[:2] == 7.0).all()
    assert source[:2].tolist() == [-5, -5]
    assert (source[2:count] >= 100).all()
    assert decode(readings, ~ALL, 1.6, RADIUS, 0.0, out, source, 2, 100) == 2
