"""The scene: the robot's measured numbers, and vases that sleep until they are touched."""

from __future__ import annotations

import numpy as np
import pytest

from pointgoal.scene import build_scene
from pointgoal.simulation import Simulation, State


def test_the_robot_has_the_measured_mass_and_damping() -> None:
    model = build_scene(1)
    robot = model.body("robot").id
    assert model.body_mass[robot] == pytest.approx(5.18879e-3, rel=1e-6)
    assert model.body_ipos[robot, 0] == pytest.approx(0.01927, abs=1e-5)
    np.testing.assert_allclose(model.dof_damping[:3], [0.01, 0.01, 0.005])


def vase_ahead(sleep: bool) -> Simulation:
    """A robot 0.6 m behind a vase that has lain there for two seconds, and no hazard near."""
    simulation = Simulation(1, 1, model=build_scene(1, sleep=sleep))
    state = {
        "pose": [[-0.6, 0.0, 0.0]],
        "velocity": np.zeros((1, 3)),
        "goal": [[0.0, 3.0]],
        "hazards": np.full((1, 8, 2), 9.0),
        "vase_qpos": [[[0.0, 0.0, 0.09996, 1.0, 0.0, 0.0, 0.0]]],
        "vase_qvel": np.zeros((1, 1, 6)),
    }
    simulation.set_state(np.array([0]), State.from_mapping(state, 1, 1))
    for _ in range(100):
        simulation.step(np.zeros((1, 2)))
    return simulation


def drive(simulation: Simulation, steps: int) -> np.ndarray:
    """x of robot and vase (steps, 2) under full thrust."""
    return np.array(
        [
            (simulation.step(np.array([[1.0, 0.0]])), simulation.pose[0, 0], simulation.vases[0, 0, 0])[1:]
            for _ in range(steps)
        ]
    )


def test_a_resting_vase_sleeps_and_wakes_when_the_robot_touches_it() -> None:
    simulation = vase_ahead(sleep=True)
    awake = simulation.batch.bind("tree_awake")
    simulation.step(np.zeros((1, 2)))
    robot, vase = 0, 1
    assert awake[0, robot]
    assert not awake[0, vase]
    path = []
    for _ in range(150):
        simulation.step(np.array([[1.0, 0.0]]))
        path.append((simulation.pose[0, 0], simulation.vases[0, 0, 0], awake[0, vase]))
    robot_x, vase_x, vase_awake = np.array(path).T
    # The arrow's front is 0.15 m ahead of the robot's origin, the vase's side 0.1 m before its centre.
    untouched = robot_x < -0.26
    assert not vase_awake[untouched].any()
    assert (vase_x[untouched] == vase_x[0]).all()
    assert vase_awake[~untouched].any()
    assert vase_x[-1] > 0.2


def test_sleep_changes_nothing_that_the_robot_can_notice() -> None:
    with_sleep, without = (drive(vase_ahead(sleep), 25) for sleep in (True, False))
    before_touch = without[:, 0] < -0.3
    assert before_touch.any()
    np.testing.assert_allclose(with_sleep[before_touch], without[before_touch], atol=1e-6)
    np.testing.assert_allclose(with_sleep, without, atol=2e-3)
