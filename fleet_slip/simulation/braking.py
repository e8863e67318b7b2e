"""One car whose wheels brake singly, beside the driver: what stability control acts with."""

from typing import Any, NamedTuple

import numba

from fleet_slip.compiling import equation
from fleet_slip.vehicle.dynamics import Derivative, driven_body, rates_of
from fleet_slip.vehicle.integration import SECOND_ORDER, Slopes, advance
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.state import Controls, State
from fleet_slip.vehicle.wheels import (
    Acceleration,
    ackermann,
    braked_spins,
    build_wheel_forces,
    driver_brakes,
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
def braked_derivative(x: State, u: Controls, brakes: Brakes, c: Constants) -> Derivative:
    """Return the rates of a car with all extensions and a brake at each wheel."""
    load = transferred_loads(x, c)
    force = _forces(x, ackermann(x, u, c), load, c)
    motion: Acceleration = driven_body(x, u, force, c)
    front, rear = driver_brakes(x, c)
    each = (front + brakes.fl, front + brakes.fr, rear + brakes.rl, rear + brakes.rr)
    return rates_of(x, u, motion, braked_spins(x, force, load, each, c), c)


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
