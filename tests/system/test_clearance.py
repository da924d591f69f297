"""The backups' clearances, and the floor: one step with any action costs no more than `loss` takes off."""

import math
from itertools import pairwise

import numpy as np
import pytest

from decision import PLAN_STEPS
from filter import FilterConfig
from filter.config import settings as make_settings
from system.backups import BACKUPS, TURN, law
from system.clearance import best_backup, clearance, clearances, loss
from system.compiled import entry
from system.obstacles import COLUMNS, FAR, least_gap
from system.point_robot import State, advance, follow, stopping


@entry
def after_one_step(settings, draws, places, kept, kind, thrusts):
    """What the sure backup keeps after one step from states that stand right on their floor.

    Args:
        settings: (1,) the filter's.
        draws: (N, 5) vx, vy, yaw rate, share of full thrust, turn.
        places: (N, n, 2) centres of discs [m].
        kept: (N,) receives the least clearance [m], on the way of the step and of the backup after it; inf
            where no radius puts the state on its floor.
        kind: (N,) receives the sure backup.
        thrusts: (N,) receives its steps.
    """
    c = settings[0]
    robot = c.robot
    n = places.shape[1]
    obstacles = np.zeros((n, COLUMNS))
    each = np.empty(n)
    for k in range(len(draws)):
        vx, vy, w, share, turn = draws[k]
        for i in range(n):
            obstacles[i, 0], obstacles[i, 1] = places[k, i]
            obstacles[i, 4] = 0.21
            obstacles[i, 6] = math.hypot(places[k, i, 0], places[k, i, 1]) - 0.21
        state = State(0.0, 0.0, 0.0, vx, vy, w)
        start = stopping(robot, state)
        # Whatever the discs' radius is, all clearances change with it: so none is lost on easy states.
        spare = best_backup(c, obstacles, n, start, FAR, True)[0] - 1e-7
        if spare < -0.2:
            kept[k] = math.inf
            continue
        for i in range(n):
            obstacles[i, 4] += spare
            obstacles[i, 6] -= spare
        sure = best_backup(c, obstacles, n, start, 0.0, True)
        kind[k], thrusts[k] = sure[2], sure[3]
        if sure[0] < 0.0:
            kept[k] = math.inf
            continue
        least = FAR
        at = state
        for _ in range(robot.substeps):
            after = advance(robot, at, share * robot.force_limit, turn, 1)
            way = least_gap(obstacles, n, at.x, at.y, after.x, after.y, -1, -FAR)[0]
            least = min(least, way)
            at = after
        clearances(c, sure[2], sure[3], obstacles, n, stopping(robot, at), each)
        kept[k] = min(least, each.min())


def draw(rng, n, hazards):
    """States of all speeds, hazards where they matter, and mostly extreme actions."""
    speed = 1.5 * rng.random(n) ** 0.4
    course = rng.uniform(0.0, 2 * np.pi, n)
    rate = rng.uniform(-3.0, 3.0, n)
    rate = np.where(rng.random(n) < 0.4, rng.choice([-3.0, 3.0], n), rate)
    action = rng.uniform(-1.0, 1.0, (n, 2))
    action = np.where(rng.random((n, 2)) < 0.7, rng.choice([-1.0, 1.0], (n, 2)), action)
    distance = 0.23 + rng.random((n, hazards)) * speed[:, None] * 0.5 + 0.05 * rng.random((n, hazards))
    bearing = course[:, None] + 0.7 * rng.normal(size=(n, hazards))
    places = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=2)
    motion = np.stack([speed * np.cos(course), speed * np.sin(course), rate], axis=1)
    return np.ascontiguousarray(np.hstack([motion, action])), places


def check_floor(total):
    """Let a third of the states have one hazard, a third two, a third three."""
    numbers = make_settings(FilterConfig())
    rng = np.random.default_rng(0)
    for hazards in (1, 2, 3):
        n = total // 3
        draws, places = draw(rng, n, hazards)
        kept, kind, thrusts = np.empty(n), np.full(n, -1), np.full(n, -1)
        after_one_step(numbers, draws, places, kept, kind, thrusts)
        stood = np.isfinite(kept)
        worst = int(kept.argmin())
        assert kept[worst] >= 0.0, (kept[worst], draws[worst].tolist(), places[worst].tolist())
        assert stood.mean() > 0.9
        assert (kind[stood] != TURN).all()
        # The bound is no luxury: some states use up most of it. And all lengths of thrust occur.
        assert kept[stood].min() < 0.02
        assert len(np.unique(thrusts[stood])) > 12


def test_after_any_one_step_from_a_state_on_its_floor_the_sure_backup_stays_clear():
    check_floor(100_000)


@pytest.mark.long
def test_after_any_one_step_from_a_million_states_on_their_floor():
    check_floor(1_000_000)


def discs(*places, radius=0.21):
    out = np.zeros((len(places), COLUMNS))
    out[:, :2] = places
    out[:, 4] = radius
    out[:, 6] = np.linalg.norm(out[:, :2], axis=1) - radius
    return out


def random_cases(n, seed=0):
    rng = np.random.default_rng(seed)
    draws, places = draw(rng, n, 3)
    for motion, at in zip(draws, places, strict=True):
        yield State(0.0, 0.0, 0.0, *motion[:3]), discs(*at)


@pytest.fixture(scope="module")
def numbers():
    return make_settings(FilterConfig(travel_error=0.05))[0]


def by_hand(settings, kind, steps, obstacles, start):
    """Clearance of a backup from each obstacle, along its polyline of points 1 mm apart."""
    at, points, travelled = start, [(start.x, start.y)], 0.0
    for _ in range(steps):
        after = follow(settings["robot"], at, *law(settings["robot"], kind, at))
        points.append((after.x, after.y))
        travelled += math.hypot(after.x - at.x, after.y - at.y)
        at = after
    points.append((at.zx, at.zy))
    rest = settings["travel_error"] * (travelled + math.hypot(at.zx - at.x, at.zy - at.y))
    corners = np.array(points)
    way = np.concatenate(
        [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / 1e-3)) for a, b in pairwise(corners)]
    )
    away = np.linalg.norm(way[:, None] - obstacles[None, :, :2], axis=2).min(axis=0)
    return away - obstacles[:, 4] - rest


def test_clearances_are_those_of_the_path(numbers):
    for k, (state, obstacles) in enumerate(random_cases(150)):
        start = stopping(numbers["robot"], state)
        kind, steps = k % BACKUPS, (7 * k) % (PLAN_STEPS + 1)
        out = np.empty(3)
        clearances(numbers, kind, steps, obstacles, 3, start, out)
        np.testing.assert_allclose(out, by_hand(numbers, kind, steps, obstacles, start), atol=6e-4)


def test_the_clearance_is_the_best_over_the_steps_of_thrust(numbers):
    for k, (state, obstacles) in enumerate(random_cases(150, seed=1)):
        start = stopping(numbers["robot"], state)
        kind = k % BACKUPS
        out, every = np.empty(3), []
        for steps in range(PLAN_STEPS + 1):
            clearances(numbers, kind, steps, obstacles, 3, start, out)
            every.append((out.min(), int(out.argmin())))
        value, nearest, steps = clearance(numbers, kind, obstacles, 3, start, FAR, -1, True, False, -FAR)
        assert value == pytest.approx(max(every)[0], abs=1e-9)
        assert every[steps] == (pytest.approx(value, abs=1e-9), nearest)


def test_the_best_backup_is_the_best_and_the_sure_one_pays_for_any_action(numbers):
    for state, obstacles in random_cases(150, seed=2):
        start = stopping(numbers["robot"], state)
        every = [
            clearance(numbers, kind, obstacles, 3, start, FAR, -1, True, False, -FAR)
            for kind in range(BACKUPS)
        ]
        here = np.linalg.norm(obstacles[:, :2], axis=1).min() - 0.21
        value, _, kind, steps = best_backup(numbers, obstacles, 3, start, FAR, False)
        assert value == pytest.approx(min(max(e[0] for e in every), here), abs=1e-8)
        sure, _, kind, steps = best_backup(numbers, obstacles, 3, start, FAR, True)
        assert kind != TURN
        out = np.empty(3)
        clearances(numbers, kind, steps, obstacles, 3, start, out)
        assert sure <= out.min() - loss(numbers, steps) + 1e-9
        assert sure <= value - loss(numbers, 0) + 1e-8


def test_a_bound_on_what_is_enough_changes_no_verdict(numbers):
    for state, obstacles in random_cases(300, seed=3):
        start = stopping(numbers["robot"], state)
        for charged in (False, True):
            exact = best_backup(numbers, obstacles, 3, start, FAR, charged)[0]
            for enough in (0.0, 0.05):
                assert (best_backup(numbers, obstacles, 3, start, enough, charged)[0] >= enough) == (
                    exact >= enough
                )


def test_loss_grows_with_the_steps_and_nothing_in_reach_is_far(numbers):
    costs = [loss(numbers, steps) for steps in range(PLAN_STEPS + 1)]
    assert costs == sorted(costs)
    assert costs[0] > 0.03  # full thrust alone moves the stop point by 3 cm
    start = stopping(numbers["robot"], State(0.0, 0.0, 0.0, 1.5, 0.0, 0.0))
    value, nearest, _, steps = best_backup(numbers, np.empty((0, COLUMNS)), 0, start, 0.0, True)
    assert value > 1e8
    assert (nearest, steps) == (-1, 0)
