"""Equations of motion of a car with four wheels, for highway-env's class and the lane kernel.

Symbols, sources and limits: `docs/vehicle.md`.
"""

from collections.abc import Callable
from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State
from fleet_slip.vehicle.wheels import (
    Acceleration,
    WheelForces,
    WheelRate,
    WheelRates,
    ackermann,
    build_wheel_forces,
    driven_spins,
    free_spins,
    parallel,
    static_loads,
    transferred_loads,
)


class Extensions(NamedTuple):
    """What the model has beyond highway-env's `BicycleVehicle`; each is fixed at compile time."""

    brush_tyres: bool = True
    """Brush tyres in the frame of each wheel; else linear ones in slip angle on two axles."""
    load_transfer: bool = True
    steering: bool = True
    """Ackermann geometry and the lag of the steering; else parallel wheels without lag."""
    drivetrain: bool = True
    """Wheels spin under torque, drag and rolling resistance; else they roll freely, as demanded."""


NO_EXTENSIONS = Extensions(False, False, False, False)


class Derivative(NamedTuple):
    """Rates of the state, and what an accelerometer at the centre of gravity reads."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    ax_lag: float
    ay_lag: float
    wheel_fl: WheelRate
    wheel_fr: WheelRate
    wheel_rl: WheelRate
    wheel_rr: WheelRate
    ax: float
    """Longitudinal specific force v̇x − r vy."""
    ay: float
    """Lateral specific force v̇y + r vx."""


@equation
def driven_body(x: State, _u: Controls, force: WheelForces, c: Constants) -> Acceleration:
    """Newton and Euler in the car's frame: m (v̇ + ω × v) = ΣF, I ṙ = ΣM."""
    air = c.drag_per_mass * abs(x.vx) * x.vx
    x_front, x_rear = force.fl.x + force.fr.x, force.rl.x + force.rr.x
    ax = (x_front + x_rear) * c.inverse_mass - air
    y_front, y_rear = force.fl.y + force.fr.y, force.rl.y + force.rr.y
    ay = (y_front + y_rear) * c.inverse_mass
    moment = (
        c.front * y_front
        - c.rear * y_rear
        + c.half_track_front * (force.fr.x - force.fl.x)
        + c.half_track_rear * (force.rr.x - force.rl.x)
    )
    return Acceleration(
        ax, ay, ax + x.yaw_rate * x.vy, ay - x.yaw_rate * x.vx, moment * c.inverse_yaw_inertia
    )


@equation
def _commanded_body(x: State, u: Controls, force: WheelForces, c: Constants) -> Acceleration:
    """As `driven_body`, with vx following the demanded acceleration."""
    free = driven_body(x, u, force, c)
    return Acceleration(u.traction - x.yaw_rate * x.vy, free.ay, u.traction, free.vy, free.yaw_rate)


@equation
def rates_of(
    x: State, u: Controls, motion: Acceleration, spin: WheelRates, c: Constants
) -> Derivative:
    """Return the rates of the whole state from those of body and wheels."""
    return Derivative(
        motion.vx,
        motion.vy,
        motion.yaw_rate,
        (u.steering_wheel - x.steering_wheel) * c.inverse_steering_lag,
        (u.traction - x.traction) * c.inverse_drive_lag,
        (motion.ax - x.ax_lag) * c.inverse_pitch_lag,
        (motion.ay - x.ay_lag) * c.inverse_roll_lag,
        spin.fl,
        spin.fr,
        spin.rl,
        spin.rr,
        motion.ax,
        motion.ay,
    )


def build_derivative(extensions: Extensions) -> Callable[[State, Controls, Constants], Derivative]:
    """Compile the equations of motion: a pure function of (state, controls, constants)."""
    directions = ackermann if extensions.steering else parallel
    loads = transferred_loads if extensions.load_transfer else static_loads
    forces = build_wheel_forces(extensions.brush_tyres, extensions.drivetrain)
    body = driven_body if extensions.drivetrain else _commanded_body
    spins = driven_spins if extensions.drivetrain else free_spins

    @equation
    def derivative(x: State, u: Controls, c: Constants) -> Derivative:
        load = loads(x, c)
        force = forces(x, directions(x, u, c), load, c)
        motion = body(x, u, force, c)
        return rates_of(x, u, motion, spins(x, force, load, motion, c), c)

    return derivative


derivative = build_derivative(Extensions())
