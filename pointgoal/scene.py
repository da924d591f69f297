"""The MuJoCo scene: the point robot on its floor, and the vases. Hazards and goal are not simulated."""

from __future__ import annotations

import mujoco
import numpy as np

from pointgoal.observation import NUM_VASES

TIMESTEP = 0.002
"""Physics step [s]."""
PHYSICS_STEPS = 10
"""Physics steps in one control step."""
STEP_SECONDS = TIMESTEP * PHYSICS_STEPS
"""Duration of a control step [s]."""
VASE_SIZE = 0.1
"""Half the side of a vase, a box [m]."""
VASE_HEIGHT = VASE_SIZE - 4e-5
"""Height of a resting vase's centre [m]: it sinks into the soft contact by 0.04 mm."""
ROBOT_QPOS = 3
"""The robot's generalised positions: x, y, heading; velocities likewise."""
VASE_QPOS, VASE_QVEL = 7, 6
"""Generalised positions and velocities of a vase's free joint."""

_ROBOT_GEOMS = ("body", "arrow")
_SENSORS = (
    ("accelerometer", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ("velocimeter", mujoco.mjtSensor.mjSENS_VELOCIMETER),
    ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
    ("magnetometer", mujoco.mjtSensor.mjSENS_MAGNETOMETER),
)


def build_scene(level: int, sleep: bool = True) -> mujoco.MjModel:
    """Compile the scene of a level.

    The generalised positions are the robot's (x, y, heading), in the world frame, then seven of each
    vase. The sensors stand in the observation's order. Controls are clipped by the model to ±1.

    Args:
        level: 0, 1 or 2.
        sleep: whether a resting vase is put to sleep until something touches it. The robot never sleeps.
    """
    spec = mujoco.MjSpec()
    spec.modelname = f"PointGoal{level}"
    spec.option.timestep = TIMESTEP
    # Contacts solved to the end: stopping at the default 1e-8 moves a sliding vase by what parity can see.
    spec.option.tolerance = 1e-12
    if sleep:
        # Below the speed at which level 2 charges for a moving vase, so that sleep never hides a cost.
        spec.option.sleep_tolerance = 5e-5
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    world = spec.worldbody
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3.5, 3.5, 0.1], condim=6)
    _add_robot(spec)
    for i in range(NUM_VASES[level]):
        vase = world.add_body(name=f"vase{i}", pos=[0, 0, VASE_HEIGHT])
        vase.add_freejoint()
        vase.add_geom(
            name=f"vase{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[VASE_SIZE] * 3,
            density=0.001,
            condim=6,
        )
    return spec.compile()


def robot_constants(model: mujoco.MjModel) -> dict[str, float | int]:
    """The robot's constants as MuJoCo compiled them, named as `system.Robot` names them.

    Args:
        model: a scene's.
    """
    body, thrust = model.body("robot"), model.actuator("thrust")
    mass, offset = float(body.mass[0]), float(body.ipos[0])
    # The principal axes may stand in any order: the moment about the vertical one, then about the origin.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    about_centre = float(rotation.reshape(3, 3)[2] ** 2 @ body.inertia)
    return {
        "mass": mass,
        "inertia": about_centre + mass * offset**2,
        "offset": offset,
        "drag": float(model.dof_damping[model.joint("x").dofadr[0]]),
        "yaw_drag": float(model.dof_damping[model.joint("heading").dofadr[0]]),
        "gear": float(thrust.gear[0]),
        "force_limit": float(thrust.forcerange[1]),
        "physics_step": float(model.opt.timestep),
        "substeps": PHYSICS_STEPS,
    }


def _add_robot(spec: mujoco.MjSpec) -> None:
    robot = spec.worldbody.add_body(name="robot", pos=[0, 0, 0.1])
    robot.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
    for name, kind, axis, damping in (
        ("x", mujoco.mjtJoint.mjJNT_SLIDE, [1, 0, 0], 0.01),
        ("y", mujoco.mjtJoint.mjJNT_SLIDE, [0, 1, 0], 0.01),
        ("heading", mujoco.mjtJoint.mjJNT_HINGE, [0, 0, 1], 0.005),
    ):
        robot.add_joint(name=name, type=kind, axis=axis, damping=damping)
    body, arrow = _ROBOT_GEOMS
    robot.add_geom(
        name=body,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.1, 0, 0],
        density=1,
        condim=6,
        friction=[1, 0.01, 0.01],
    )
    robot.add_geom(
        name=arrow,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.05] * 3,
        pos=[0.1, 0, 0],
        density=1,
        condim=6,
    )
    robot.add_site(name="robot")
    for sensor, kind in _SENSORS:
        spec.add_sensor(name=sensor, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="robot")
    # With the floor left out (its friction has no normal force to act on: the robot cannot move in z), every
    # contact of the robot is one with a vase.
    spec.add_exclude(bodyname1="world", bodyname2="robot")
    touch = spec.add_sensor(
        name="vase_contacts",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname="robot",
    )
    touch.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1]
    limits = {"ctrllimited": True, "ctrlrange": [-1, 1], "forcelimited": True, "forcerange": [-0.05, 0.05]}
    thrust = spec.add_actuator(
        name="thrust",
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        target="robot",
        gear=[0.3, 0, 0, 0, 0, 0],
        **limits,
    )
    thrust.set_to_motor()
    turn = spec.add_actuator(
        name="turn",
        trntype=mujoco.mjtTrn.mjTRN_JOINTINPARENT,
        target="heading",
        gear=[0.3, 0, 0, 0, 0, 0],
        **limits,
    )
    turn.set_to_velocity(kv=1.0)
