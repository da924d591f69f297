"""Who is led: nobody, from a refusal on, or ahead; and where to."""

from collections import Counter

import numpy as np
import pytest

from decision import MEMORY, Mode, Origin
from filter import BarrierFilter, FilterConfig
from guide import DEFAULT_STRENGTH, STRENGTHS, Guide, GuideConfig


@pytest.fixture(scope="module")
def guided():
    """A filter for each strength."""
    config = FilterConfig()
    return {strength: BarrierFilter(config, Guide(config, strength)) for strength in STRENGTHS}


def run(robot_filter, drive, policy, source, steps, n=40):
    """Yields the memory before, what was decided and the moment."""
    memory = np.zeros(n, MEMORY)
    rng = np.random.default_rng(0)
    for now in drive(steps, n=n):
        action = policy(now.observation, now.hazards, rng)
        decided = robot_filter.filter(
            now.observation, action, now.hazards if source == "given" else None, memory
        )
        yield memory, decided, now
        memory, now.action = decided.memory, decided.action


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("strength", STRENGTHS)
def test_whom_each_strength_leads_and_no_violation(guided, hand, drive, strength, source):
    modes, replaced = Counter(), 0
    for before, decided, now in run(guided[strength], drive, hand.seeker, source, 300):
        assert (now.cost == 0.0).all()
        mode, origin, certified = decided.mode, decided.origin, decided.certified
        np.testing.assert_array_equal(origin == "", mode == Mode.NOMINAL)
        np.testing.assert_array_equal(origin == Origin.GUIDE, mode == Mode.GUIDED)
        np.testing.assert_array_equal(
            np.isin(origin, (Origin.BARRIER, Origin.CIRCULATION, Origin.SEARCH)), mode == Mode.FILTERED
        )
        assert (decided.hazard[mode == Mode.FILTERED] >= 0).all()
        passed = mode == Mode.NOMINAL
        np.testing.assert_array_equal(decided.action[passed], decided.nominal_action[passed])
        modes.update(mode.tolist())
        over = certified & ~passed
        replaced += int(over.sum())
        if strength == "off":
            assert not over.any()
            assert (decided.memory["guided"] == 0).all()
        if strength == "refusal":
            # Only who was refused before and is not past yet; whoever begins to be led is refused.
            assert (before["guided"][over] != 0).all()
            begins = (decided.memory["guided"] != 0) & (before["guided"] == 0)
            assert not certified[begins].any()
    assert (modes[Mode.GUIDED] > 0) == (strength != "off")
    assert (replaced > 0) == (strength != "off")
    assert modes[Mode.FILTERED] > 0


def test_ahead_replaces_more_than_from_a_refusal_on_and_all_of_it_is_counted(guided, hand, drive):
    counts = {}
    for strength in STRENGTHS:
        counts[strength] = Counter()
        for _, decided, _ in run(guided[strength], drive, hand.seeker, "given", 300):
            counts[strength].update(decided.origin.tolist())
    assert counts["off"][Origin.GUIDE] == 0
    assert 0 < counts["refusal"][Origin.GUIDE] < counts["ahead"][Origin.GUIDE]


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("strength", ["refusal", "ahead"])
def test_who_has_a_certified_action_is_not_given_an_uncertified_one(guided, hand, drive, strength, source):
    # The guide only proposes: if all that it leads to fails, the nominal action is still there.
    for _, decided, _ in run(guided[strength], drive, hand.seeker, source, 500):
        assert not (decided.certified & (decided.mode == Mode.FALLBACK)).any()


def test_it_ends_when_the_robot_is_past(guided, hand):
    # Led past a hazard, and then on its own again, though something certified is all it ever asks for.
    hazards, goal, at = np.array([[0.9, 0.01]]), np.array([2.6, 0.0]), np.zeros(6)
    memory, led = np.zeros(1, MEMORY), []
    for _ in range(300):
        seen, ahead = hand.in_body_frame(at, hazards), hand.in_body_frame(at, goal[None])[0]
        turned = hand.in_body_frame(np.array([0, 0, at[2]]), at[None, 3:5])[0]
        observation = hand.observe(seen, tuple(turned), at[5], ahead)[None]
        nominal = hand.seeker(observation, seen[None], None)
        decided = guided["refusal"].filter(observation, nominal, seen[None], memory)
        memory = decided.memory
        led.append(decided.mode[0] == Mode.GUIDED)
        at = hand.step_exactly(at, decided.action[0])
        if np.linalg.norm(goal - at[:2]) < 0.3:
            break
    else:
        pytest.fail(f"stuck at {at[:2]}")
    first = led.index(True)
    assert first > 0  # not before it was refused
    assert not any(led[-15:])
    assert memory["guided"][0] == 0


@pytest.mark.parametrize("scanned", [False, True])
@pytest.mark.parametrize("offset", [0.0, 0.01, -0.1])
@pytest.mark.parametrize("strength", ["refusal", "ahead"])
def test_a_robot_gets_past_what_stands_in_its_way(guided, hand, strength, offset, scanned):
    # Two hazards that overlap, so that there is a notch to be caught in; the goal straight behind. Ahead, it
    # needs no memory for that: where both sides are alike and a scan shows one or the other as the nearer, it
    # turns about a few times, and how often is decided by last bits.
    hazards = np.array([[1.0, 0.17 + offset], [1.0, -0.17 + offset]])
    goal, at, memory = np.array([2.2, 0.0]), np.zeros(6), None
    for _ in range(1000 if strength == "ahead" and scanned else 400):
        seen, ahead = hand.in_body_frame(at, hazards), hand.in_body_frame(at, goal[None])[0]
        motion = hand.in_body_frame(np.array([0, 0, at[2]]), at[None, 3:5])[0]
        observation = hand.observe(seen, tuple(motion), at[5], ahead)[None]
        stop = ahead - 0.4 * motion
        nominal = np.array([[1.0, np.clip(4 * np.arctan2(stop[1], stop[0]), -1, 1)]])
        decided = guided[strength].filter(observation, nominal, None if scanned else seen[None], memory)
        memory = decided.memory if strength == "refusal" else None
        at = hand.step_exactly(at, decided.action[0])
        assert np.linalg.norm(hazards - at[:2], axis=1).min() > 0.2
        if np.linalg.norm(goal - at[:2]) < 0.3:
            return
    pytest.fail(f"stuck at {at[:2]}")


@pytest.mark.parametrize("front", [1.0, -1.0])
def test_either_end_of_the_robot_may_lead_the_way_round(guided, hand, front):
    # The same scene ahead and astern, and a policy that would rather stay.
    hazards, goal = front * np.array([[0.6, 0.02]]), front * np.array([2.2, 0.0])
    for ahead in (0.0, 0.5):
        observation = hand.observe(hazards, (front * ahead, 0.0), 0.0, goal)[None]
        result = guided["ahead"].filter(observation, np.zeros((1, 2)), hazards[None])
        assert result.origin[0] == Origin.GUIDE
        assert front * result.action[0, 0] > 0.03
        assert 0.0 < abs(result.action[0, 1]) <= 1.0


def test_nobody_is_led_where_nothing_is_in_the_way_nor_while_the_gate_is_closed(guided, hand):
    aside, goal = np.array([[0.0, 1.0]]), np.array([2.0, 0.0])
    free = hand.observe(aside, (0.3, 0.0), 0.0, goal)[None]
    blocked = hand.observe(np.array([[0.7, 0.0]]), (0.3, 0.0), 0.0, goal)[None]
    nominal = np.array([[0.2, 0.1]])
    for strength in STRENGTHS:
        assert guided[strength].filter(free, nominal, aside[None]).mode.tolist() == [Mode.NOMINAL]
        closed = guided[strength].filter(blocked, nominal, active=[False])
        np.testing.assert_array_equal(closed.action, nominal)
    memory = np.zeros(1, MEMORY)
    memory["guided"] = 1
    closed = guided["refusal"].filter(blocked, nominal, None, memory, [False])
    assert closed.memory["guided"][0] == 0
    assert guided["refusal"].filter(free, nominal, aside[None], memory).memory["guided"][0] == 0


def test_a_batch_is_led_as_its_robots_alone(guided, hand):
    rng = np.random.default_rng(2)
    n = 60
    distance, bearing = rng.uniform(0.3, 1.0, (n, 3)), rng.uniform(-0.8, 0.8, (n, 3))
    hazards = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=2)
    observation = np.array([hand.observe(at, (rng.uniform(0, 0.8), 0.0), 0.0, (1.8, 0.0)) for at in hazards])
    action = np.tile([1.0, 0.0], (n, 1))
    memory = np.zeros(n, MEMORY)
    memory["guided"], memory["side"] = rng.integers(-1, 2, n), rng.integers(-50, 51, n)
    for strength in STRENGTHS:
        for source in (hazards, None):
            together = guided[strength].filter(observation, action, source, memory)
            for k in range(n):
                row = slice(k, k + 1)
                alone = guided[strength].filter(
                    observation[row], action[row], None if source is None else source[row], memory[row]
                )
                for name in ("action", "mode", "origin", "hazard", "memory"):
                    np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[k])


def test_the_strengths():
    assert DEFAULT_STRENGTH in STRENGTHS
    assert Guide().strength == DEFAULT_STRENGTH
    assert STRENGTHS == ("off", "refusal", "ahead")
    with pytest.raises(ValueError, match="guide must be one of off, refusal, ahead, got 'boldly'"):
        Guide(strength="boldly")


@pytest.mark.parametrize(
    "change", [{"lookahead": 0.0}, {"clearance": np.nan}, {"repulsion": -1.0}, {"slow": np.inf}]
)
def test_settings_without_a_meaning_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        GuideConfig(**change)
