"""The filter in the real simulation: hostile and clumsy policies, and nobody enters a hazard."""

from collections import Counter

import numpy as np
import pytest

from decision import MEMORY, Mode, Origin, next_of_plan
from filter import BarrierFilter, FilterConfig
from filter.config import MODEL_ERROR
from guide import Guide
from pointgoal.observation import HAZARD_RADIUS


@pytest.mark.parametrize("source", ["given", "lidar"])
@pytest.mark.parametrize("policy", ["attacker", "random"])
def test_no_violation(robot_filter, hand, drive, source, policy):
    rng = np.random.default_rng(0)
    memory = np.zeros(48, MEMORY)
    changed = 0
    for now in drive(300, n=48):
        assert (now.cost == 0.0).all()
        action = getattr(hand, policy)(now.observation, now.hazards, rng)
        result = robot_filter.filter(
            now.observation, action, now.hazards if source == "given" else None, memory
        )
        memory, now.action = result.memory, result.action
        changed += int((result.mode != Mode.NOMINAL).sum())
    assert changed > (100 if policy == "attacker" else 10)


@pytest.mark.parametrize("source", ["given", "lidar"])
def test_the_qps_own_solution_decides(robot_filter, hand, drive, source):
    origins, memory = Counter(), np.zeros(40, MEMORY)
    for now in drive(500):
        assert (now.cost == 0.0).all()
        action = hand.seeker(now.observation, now.hazards, None)
        result = robot_filter.filter(
            now.observation, action, now.hazards if source == "given" else None, memory
        )
        memory, now.action = result.memory, result.action
        origins.update(result.origin.tolist())
    del origins[""]
    total = origins.total()
    assert total > 2000
    assert origins[Origin.BARRIER] + origins[Origin.CIRCULATION] >= 0.9 * total
    assert origins[Origin.SEARCH] <= 0.05 * total
    assert min(origins[Origin.BARRIER], origins[Origin.CIRCULATION]) > 0.1 * total


def erratic(rng, n, step, last):
    """Nearly full thrust, and a turn that is held for a while: fast, and in no one's way."""
    if step % 25:
        return last
    return np.stack([rng.choice([1.0, 1.0, -1.0], n), rng.uniform(-0.6, 0.6, n)], axis=1)


@pytest.mark.parametrize(
    ("source", "policy", "margin", "steps"),
    [
        ("given", "attacker", 0.01, 100),
        ("lidar", "attacker", 0.01, 100),
        ("lidar", "erratic", 0.01, 100),
        # With no margin to give up, the plan alone carries the robot over what a new scan leaves possible.
        ("lidar", "attacker", MODEL_ERROR, 190),
        ("lidar", "erratic", MODEL_ERROR, 100),
    ],
)
def test_what_is_remembered_stays_clear_of_the_true_hazards_for_ever(
    hand, drive, source, policy, margin, steps
):
    # The induction: whatever is sent, the plan that is remembered with it never comes near a hazard, though
    # the filter has seen nothing but scans. Robot and hazards are the true ones here.
    robot_filter = BarrierFilter(FilterConfig(margin=margin))
    n = 32
    rng = np.random.default_rng(0)
    memory, continued, action = np.zeros(n, MEMORY), 0, np.zeros((n, 2))
    for now in drive(steps, n=n, seed=70):
        if policy == "attacker":
            action = hand.attacker(now.observation, now.hazards, rng)
        else:
            action = erratic(rng, n, now.step, action)
        result = robot_filter.filter(
            now.observation, action, now.hazards if source == "given" else None, memory
        )
        least = hand.least_distance_of_the_plan(now.state, result.action, result.memory, now.hazards)
        assert least.min() > HAZARD_RADIUS
        certified = result.mode != Mode.FALLBACK
        assert least[certified].min() > HAZARD_RADIUS + margin - MODEL_ERROR
        # Where nothing keeps clear of all that the scan leaves possible, the last plan goes on.
        goes_on = np.array([str(reason).endswith("the plan goes on") for reason in result.reason])
        np.testing.assert_array_equal(result.action[goes_on], next_of_plan(memory)[0][goes_on])
        continued += int(goes_on.sum())
        memory, now.action = result.memory, result.action
    assert continued > 0 or margin > MODEL_ERROR


def test_of_the_closed_gate_the_sure_backup_is_what_is_left(robot_filter, scenes, hand):
    # Whatever was sent while the gate was closed: what is remembered survives it in the exact model.
    observation, action, hazards = scenes(3000, seed=8)
    speed = np.hypot(observation[:, 3], observation[:, 4])
    observation[:, 3:5] *= np.where(speed > 0.3, 1.3, 1.0)[:, None]
    action = np.sign(action)
    view = robot_filter.look(observation, hazards)
    closed = ~view.low
    assert closed.sum() > 800
    result = robot_filter.filter(observation, action, hazards, active=np.zeros(3000, bool))
    np.testing.assert_array_equal(result.action, action)
    assert (result.mode == Mode.NOMINAL).all()
    state = np.zeros((3000, 6))
    state[:, 3:5], state[:, 5] = observation[:, 3:5], observation[:, 8]
    least = hand.least_distance_of_the_plan(state, result.action, result.memory, hazards)
    assert least[closed].min() > HAZARD_RADIUS + robot_filter.config.margin - MODEL_ERROR
    assert (result.memory["left"][closed] > 0).any()


def test_a_plan_to_coast_goes_on_as_any_other(robot_filter, hand):
    # Nothing was in reach, so the plan is to coast, and that stays clear of the true hazards. Now a scan
    # leaves possible what no backup keeps out of: to thrust for the least harm could lead into a true one.
    nothing = np.zeros((1, 60))
    nothing[0, 3] = 1.4
    crowded = hand.observe(np.array([[0.35, 0.0]]), (1.4, 0.0))[None]
    for active in (True, False):
        before = robot_filter.filter(nothing, np.zeros((1, 2)), active=[active])
        assert before.mode.tolist() == [Mode.NOMINAL]
        after = robot_filter.filter(crowded, np.ones((1, 2)), None, before.memory)
        assert after.origin.tolist() == [Origin.PLAN]
        np.testing.assert_array_equal(after.action, [[0.0, 0.0]])
    # A robot of which nothing is known has no such plan.
    assert robot_filter.filter(crowded, np.ones((1, 2))).origin.tolist() == [Origin.HARM]


def test_a_side_is_remembered_for_a_second_and_no_longer(robot_filter, hand):
    near = np.array([[0.305, 0.03]])
    result = robot_filter.filter(hand.observe(near, (0.8, 0.0))[None], np.array([[1.0, 0.0]]), near[None])
    assert abs(result.memory["side"][0]) == 50
    side, memory = np.sign(result.memory["side"][0]), result.memory
    for left in range(49, -1, -1):
        # Also while the gate is closed.
        result = robot_filter.filter(np.zeros((1, 60)), np.zeros((1, 2)), None, memory, [left % 2 == 0])
        memory = result.memory
        assert memory["side"][0] == side * left
    assert robot_filter.filter(np.zeros((1, 60)), np.zeros((1, 2)), None, memory).memory["side"][0] == 0


@pytest.mark.parametrize("guided", [False, True])
def test_a_dead_lidar_bin_is_noticed_before_it_costs_anything(hand, drive, guided):
    """Robots that are driven at the nearest hazard, each with another bin that shows nothing."""
    robot_filter = BarrierFilter(guide=Guide() if guided else None)
    dead = np.zeros((32, 60), np.bool_)
    dead[np.arange(32), 28 + np.arange(32) % 16] = True
    memory, doubted, moved = None, 0, 0
    for now in drive(300, n=32, seed=41):
        seen = np.where(dead, 0.0, now.observation)
        result = robot_filter.filter(seen, hand.attacker(now.observation, now.hazards, None), None, memory)
        told = np.array([reason is not None and "what no hazards can" in reason for reason in result.reason])
        np.testing.assert_array_equal(told, np.isnan(result.barrier))
        assert (result.mode[told] == Mode.FALLBACK).all()
        doubted += told.sum()
        moved += (result.mode == Mode.NOMINAL).sum()
        memory, now.action = result.memory, result.action
        assert (now.cost == 0.0).all()
    assert doubted > 1000
    assert moved > 100


@pytest.mark.parametrize("index", [0, 1, 15])
def test_of_a_scan_that_contradicts_itself_nothing_follows(robot_filter, hand, index):
    at = 0.45 * np.array([np.cos(np.pi / 16), np.sin(np.pi / 16)])
    whole = hand.observe(at, (1.0, 0.0))[None]
    thrust = np.array([[1.0, 0.0]])
    before = robot_filter.filter(whole, thrust)
    assert before.memory["planned"][0]
    broken = whole.copy()
    broken[0, 28 + index] = 0.0
    # With a plan: it goes on, then the robot coasts. Robots beside it are not concerned.
    memory = np.concatenate([before.memory, before.memory])
    plan = memory["plan"][0, : memory["left"][0]].tolist()
    for action in [*plan, [0.0, 0.0], [0.0, 0.0]]:
        result = robot_filter.filter(np.vstack([broken, whole]), np.vstack([thrust, thrust]), None, memory)
        assert (result.mode[0], result.origin[0]) == (Mode.FALLBACK, Origin.PLAN)
        assert result.action[0].tolist() == action
        assert result.reason[1] is None
        memory["plan"][0], memory["left"][0] = result.memory["plan"][0], result.memory["left"][0]
    # Without one: it brakes, forwards and backwards, whatever is given beside the scan.
    for speed in (1.0, -1.0, 0.0):
        broken[0, 3] = speed
        for given in (None, np.array([[[2.0, 0.0]]])):
            result = robot_filter.filter(broken, thrust, given)
            assert (result.mode[0], result.origin[0]) == (Mode.FALLBACK, Origin.HARM)
            assert result.action[0].tolist() == [-0.05 * speed, 0.0]
            assert not result.memory["planned"][0]
    # A closed gate changes nothing.
    assert robot_filter.filter(broken, thrust, active=[False]).mode[0] == Mode.NOMINAL


def test_a_plan_that_was_left_is_forgotten(robot_filter, hand):
    # At 1.4 m/s towards a hazard that is 0.15 m away: nothing can be certified, and no old plan is any use.
    hazards = np.array([[0.35, 0.0]])
    observation = hand.observe(hazards, (1.4, 0.0))[None]
    old = np.zeros(1, MEMORY)
    old["planned"], old["left"] = True, 7
    old["plan"][0, :7] = (0.05, 0.0)
    # A hazard that is given is certain: what was planned did not reckon with it.
    blank = hand.observe(np.empty((0, 2)), (1.4, 0.0))[None]
    known = robot_filter.filter(blank, np.zeros((1, 2)), hazards[None], old)
    assert known.mode[0] == Mode.FALLBACK
    assert known.origin[0] == Origin.HARM
    assert known.memory["left"][0] == 0
    # With scans the plan may rest on what an earlier one ruled out: it is followed, and no longer than it is.
    for left in range(6, -1, -1):
        result = robot_filter.filter(observation, np.zeros((1, 2)), None, old)
        assert result.reason[0].startswith("no certified action")
        assert result.origin[0] == Origin.PLAN
        assert result.memory["left"][0] == left
        np.testing.assert_array_equal(result.action[0], [0.05, 0.0])
        old = result.memory
    # Inside a hazard no plan counts.
    inside = np.array([[0.1, 0.0]])
    planned = old.copy()
    planned["left"] = 5
    result = robot_filter.filter(hand.observe(inside, (1.4, 0.0))[None], np.zeros((1, 2)), None, planned)
    assert result.reason[0].startswith("inside")
    assert result.memory["left"][0] == 0
    # Without a plan to go on with, the least harm is done, and none is left behind.
    result = robot_filter.filter(observation, np.zeros((1, 2)))
    assert result.reason[0].startswith("too fast")
    assert result.origin[0] == Origin.HARM
    assert result.memory["left"][0] == 0


def test_other_levels(robot_filter, hand, drive):
    for level in (0, 2):
        for now in drive(60, n=8, seed=1, level=level):
            result = robot_filter.filter(now.observation, np.tile([1.0, 0.2], (8, 1)))
            now.action = result.action
        if level == 2:
            assert np.linalg.norm(now.hazards, axis=2).min() > 0.2
