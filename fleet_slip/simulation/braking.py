"""One car whose wheels brake singly, beside the driver: what stability control acts with."""

from typing import Any, NamedTuple

import numba

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import Derivative, driven_body, rates_of
from fleet_slip.vehicle.integration import SECOND_ORDER, Slopes, advance
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State
from fleet_slip.vehicle.wheels import (
    SLOWEST_DRIVE_MPS,
    Acceleration,
    Loads,
    WheelForces,
    WheelRates,
    ackermann,
    build_wheel_forces,
    spin_rate,
    transferred_loads,
)


class Brakes(NamedTuple):
    """Brake force at the rim of each wheel in N, beside the driver's, before anti-lock control."""

    fl: float
    fr: float
    rl: float
    rr: float


class Moved(NamedTuple):
    """A car after a step: its state, what the next step needs, and what its sensors felt."""

    state: State
    slopes: Slopes
    ax: float
    ay: float


_forces = build_wheel_forces(True, True)


@equation
def braked_spins(
    x: State, force: WheelForces, load: Loads, brakes: Brakes, c: Constants
) -> WheelRates:
    """Return the rates of the wheels as `driven_spins` does, each with a brake of its own."""
    strongest = c.power_per_mass / max(abs(x.vx), SLOWEST_DRIVE_MPS)
    drive = c.mass * min(max(x.traction, 0.0), strongest)
    brake = c.mass * max(-x.traction, 0.0)
    drive_f, drive_r = c.drive_front * drive, c.drive_rear * drive
    brake_f, brake_r = c.brake_front * brake, c.brake_rear * brake
    return WheelRates(
        spin_rate(force.fl, x.wheel_fl, load.fl, drive_f, brake_f + brakes.fl, c),
        spin_rate(force.fr, x.wheel_fr, load.fr, drive_f, brake_f + brakes.fr, c),
        spin_rate(force.rl, x.wheel_rl, load.rl, drive_r, brake_r + brakes.rl, c),
        spin_rate(force.rr, x.wheel_rr, load.rr, drive_r, brake_r + brakes.rr, c),
    )


@equation
def braked_derivative(x: State, u: Controls, brakes: Brakes, c: Constants) -> Derivative:
    """Return the rates of a car with all extensions and a brake at each wheel."""
    load = transferred_loads(x, c)
    force = _forces(x, ackermann(x, u, c), load, c)
    motion: Acceleration = driven_body(x, u, force, c)
    return rates_of(x, u, motion, braked_spins(x, force, load, brakes, c), c)


@numba.njit(error_model="numpy", nogil=True, cache=False)
def move(
    x: State,
    slopes: Slopes,
    u: Controls,
    brakes: Brakes,
    c: Constants,
    step_s: float,
    count: int,
    order: float,
) -> Any:
    """Return the car after so many steps; `order` is that of the first."""
    ax = ay = 0.0
    for k in range(count):
        d = braked_derivative(x, u, brakes, c)
        if k == 0:
            ax, ay = d.ax, d.ay
        x, slopes = advance(x, d, slopes, c, step_s, order)
        order = SECOND_ORDER
    return Moved(x, slopes, ax, ay)
