"""The point robot's dynamics: the exact control step, and the reduced model in which it stops in closed form.

The robot is a hovercraft: thrust along its heading, a stiff servo on the yaw rate, linear drag, and a centre
of mass ahead of its origin, which couples yaw and sideways motion. All is in the plane, in a frame that
stands still and coincides with the body at the moment of the decision: the origin at (0, 0), the heading
along x.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from system.compiled import compiled

FloatArray = NDArray[np.floating[Any]]


class Robot(NamedTuple):
    """The point robot's constants, as MuJoCo compiles them from the task's scene."""

    mass: float = 5.18879e-3
    """Mass [kg]."""
    inertia: float = 2.84218275e-5
    """Moment of inertia about the origin [kg m^2]."""
    offset: float = 1.927e-2
    """Distance of the centre of mass ahead of the origin [m]."""
    drag: float = 0.01
    """Damping of the origin's motion [N s/m]."""
    yaw_drag: float = 0.005
    """Damping of the yaw rate [N m s]."""
    gear: float = 0.3
    """Gear of both actuators."""
    force_limit: float = 0.05
    """Bound of each actuator's force before the gear; thrust saturates at a control of this size."""
    physics_step: float = 0.002
    """Length of one physics step [s]."""
    substeps: int = 10
    """Physics steps in one control step."""

    @property
    def time_constant(self) -> float:
        """Decay time of the speed without thrust [s]."""
        return self.mass / self.drag

    @property
    def stop_speed(self) -> float:
        """Speed at which full thrust moves the stop point [m/s]; also the robot's top speed."""
        return self.gear * self.force_limit / self.drag

    @property
    def turn_rate(self) -> float:
        """Yaw rate that the servo settles at under a full turn control [rad/s]: it saturates before."""
        return self.gear * self.force_limit / self.yaw_drag

    @property
    def control_step(self) -> float:
        """Length of one control step [s]."""
        return self.physics_step * self.substeps


ROBOT = np.dtype([(name, "i8" if name == "substeps" else "f8") for name in Robot._fields], align=True)
"""`Robot` as compiled code takes it."""


class State(NamedTuple):
    """Where the robot is and how it moves, in the frame of the decision."""

    x: float
    """Position of the origin [m]."""
    y: float
    """Position of the origin [m]."""
    heading: float
    """Heading [rad]."""
    vx: float
    """Velocity of the origin [m/s]."""
    vy: float
    """Velocity of the origin [m/s]."""
    yaw_rate: float
    """Yaw rate [rad/s]."""


class Stopping(NamedTuple):
    """The reduced state: where the robot is, where it would come to rest without thrust, and how it turns.

    Without thrust the momentum decays through drag alone, so the origin comes to rest exactly at
    p + tau * v_c, with v_c the velocity of the centre of mass and tau the time constant, however it turns on
    the way. This stop point obeys dz/dt = V f e(heading), f in [-1, 1] the share of full thrust and V =
    `stop_speed`: no drift; and the robot follows it, dp/dt = (z - p) / tau - c de/dt, c the offset of the
    centre of mass.
    """

    x: float
    """Position of the origin [m]."""
    y: float
    """Position of the origin [m]."""
    zx: float
    """Stop point [m]."""
    zy: float
    """Stop point [m]."""
    heading: float
    """Heading [rad]."""
    yaw_rate: float
    """Yaw rate [rad/s]."""


@compiled
def advance(robot: Robot, state: State, thrust: float, turn: float, substeps: int) -> State:
    """Step the exact model, MuJoCo's Euler integrator with its implicit joint damping.

    Args:
        robot: the constants.
        state: where to start.
        thrust: u1, clipped at the force limit.
        turn: u2 in [-1, 1].
        substeps: how many physics steps.

    Returns:
        The state after them. Against recorded steps the position is within 2e-6 m after 10 steps.
    """
    x, y, heading, vx, vy, yaw_rate = state
    h = robot.physics_step
    force = robot.gear * min(max(thrust, -robot.force_limit), robot.force_limit)
    k = robot.mass * robot.offset
    a = robot.mass + h * robot.drag
    b = robot.inertia + h * robot.yaw_drag
    for _ in range(substeps):
        s = math.sin(heading)
        c = math.cos(heading)
        effort = min(max(turn - robot.gear * yaw_rate, -robot.force_limit), robot.force_limit)
        push = force + k * yaw_rate * yaw_rate
        rx = push * c - robot.drag * vx
        ry = push * s - robot.drag * vy
        rz = robot.gear * effort - robot.yaw_drag * yaw_rate
        spin = (rz + k * (s * rx - c * ry) / a) / (b - k * k / a)
        vx += h * (rx + k * s * spin) / a
        vy += h * (ry - k * c * spin) / a
        yaw_rate += h * spin
        x += h * vx
        y += h * vy
        heading += h * yaw_rate
    return State(x, y, heading, vx, vy, yaw_rate)


@compiled
def once_arrived(robot: Robot, state: State, sent: FloatArray, steps: int) -> State:
    """The state once the last ``steps`` actions of ``sent`` (n, 2), the newest first, have taken effect."""
    for step in range(steps - 1, -1, -1):
        state = advance(robot, state, sent[step, 0], sent[step, 1], robot.substeps)
    return state


@compiled
def stopping(robot: Robot, state: State) -> Stopping:
    """The reduced state that belongs to a state."""
    tau = robot.mass / robot.drag
    lever = robot.offset * state.yaw_rate
    vx = state.vx - lever * math.sin(state.heading)
    vy = state.vy + lever * math.cos(state.heading)
    return Stopping(state.x, state.y, state.x + tau * vx, state.y + tau * vy, state.heading, state.yaw_rate)


@compiled
def swing(robot: Robot, yaw_rate: float, turn: float, aside: float) -> tuple[float, float, float]:
    """Step the yaw alone, as `advance` does, with the drag's torque about the centre of mass held.

    The servo is too stiff for its physics step: where it holds a heading, it chatters between its limits and
    has no authority left, so that torque turns the robot at a rate at which the yaw's own drag balances it.

    Args:
        robot: the constants.
        yaw_rate: to start from [rad/s]; 0: the servo chatters.
        turn: u2 in [-1, 1].
        aside: velocity of the centre of mass to the left [m/s].

    Returns:
        How far the heading turns in a control step, and how far on average over it [rad]; the yaw rate after
        it [rad/s], 0 once the servo only chatters.
    """
    h = robot.physics_step
    k = robot.mass * robot.offset
    a = robot.mass + h * robot.drag
    torque = k / a * robot.drag * aside
    if turn == 0.0 and yaw_rate == 0.0:
        angle = torque / robot.yaw_drag * h * robot.substeps
        return angle, 0.5 * angle, 0.0
    b = robot.inertia + h * robot.yaw_drag - k * k / a
    # A division in each step would take longer than all the rest of it.
    push, drag, drift = h * robot.gear / b, h * robot.yaw_drag / b, h * torque / b
    angle = 0.0
    total = 0.0
    for _ in range(robot.substeps):
        effort = min(max(turn - robot.gear * yaw_rate, -robot.force_limit), robot.force_limit)
        yaw_rate += push * effort - drag * yaw_rate + drift
        total += angle + 0.5 * h * yaw_rate
        angle += h * yaw_rate
    if turn == 0.0 and abs(yaw_rate) * b < h * robot.gear * robot.force_limit:
        yaw_rate = 0.0
    return angle, total / robot.substeps, yaw_rate


@compiled
def follow(robot: Robot, at: Stopping, thrust: float, turn: float) -> Stopping:
    """Advance the reduced model by a control step, in closed form for a thrust along the mean heading.

    Args:
        robot: the constants.
        at: where to start.
        thrust: share of full thrust, in [-1, 1].
        turn: u2 in [-1, 1].

    Returns:
        The reduced state after it.
    """
    seconds = robot.physics_step * robot.substeps
    tau = robot.mass / robot.drag
    speed = thrust * robot.gear * robot.force_limit / robot.drag
    aside = (at.zy - at.y) * math.cos(at.heading) - (at.zx - at.x) * math.sin(at.heading)
    angle, mean, yaw_rate = swing(robot, at.yaw_rate, turn, aside / tau)
    qx = speed * math.cos(at.heading + mean)
    qy = speed * math.sin(at.heading + mean)
    fade = math.exp(-seconds / tau)
    x = at.zx + qx * (seconds - tau) + (at.x - at.zx + qx * tau) * fade
    y = at.zy + qy * (seconds - tau) + (at.y - at.zy + qy * tau) * fade
    after = at.heading + angle
    # The robot turns about its centre of mass, so the origin swings round.
    x -= robot.offset * (math.cos(after) - math.cos(at.heading))
    y -= robot.offset * (math.sin(after) - math.sin(at.heading))
    return Stopping(x, y, at.zx + qx * seconds, at.zy + qy * seconds, after, yaw_rate)
