"""A car under constant demands, stepped by the package's own functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.compiling import kernel
from fleet_slip.vehicle.dynamics import NO_BRAKES, Derivative, derivative
from fleet_slip.vehicle.integration import FIRST_ORDER, SECOND_ORDER, STEP_S, Slopes, advance
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    Constants,
    Controls,
    State,
    constants,
    load_vehicle,
)

SEDAN = load_vehicle("d_class_sedan")
CAR = constants(SEDAN, adhesion=1.0)
NO_SLOPES = Slopes(*(0.0 for _ in Slopes._fields))


@kernel
def rates(x: State, u: Controls, c: Constants) -> Derivative:
    return derivative(x, u, NO_BRAKES, c)


@kernel
def _run(x: State, u: Controls, c: Constants, slopes: Slopes, step: float, count: int) -> Any:
    states = np.empty((count + 1, len(x)))
    forces = np.empty((count, 2))
    order = FIRST_ORDER
    for i in range(count):
        for k, value in enumerate(x):
            states[i, k] = value
        d = derivative(x, u, NO_BRAKES, c)
        forces[i, 0], forces[i, 1] = d.ax, d.ay
        x, slopes = advance(x, d, slopes, c, step, order)
        order = SECOND_ORDER
    for k, value in enumerate(x):
        states[count, k] = value
    return states, forces, x


class Run:
    """What happened: `states` (steps + 1, fields), specific forces (steps, 2), the last state."""

    def __init__(
        self, x: State, u: Controls, seconds: float, c: Constants = CAR, step: float = STEP_S
    ) -> None:
        self.states, self.forces, self.last = _run(x, u, c, NO_SLOPES, step, round(seconds / step))

    def __getitem__(self, field: str) -> NDArray[np.float64]:
        """Return the course of one field of the state."""
        column: NDArray[np.float64] = self.states[:, State._fields.index(field)]
        return column


def rolling(vx: float, c: Constants = CAR, **others: float) -> State:
    """Return a car that rolls straight ahead without slip, but for what is given."""
    at_rest = State(*(0.0 for _ in State._fields))
    spins = {f"wheel_{wheel}": vx * c.inverse_radius for wheel in ("fl", "fr", "rl", "rr")}
    return at_rest._replace(vx=vx, **{**spins, **others})


def holding(vx: float, c: Constants = CAR) -> float:
    """Return the traction that overcomes drag and rolling resistance."""
    return c.drag_per_mass * vx * vx + c.rolling_resistance * GRAVITY_MPS2


def kinetic_energy(states: NDArray[np.float64], c: Constants = CAR) -> NDArray[np.float64]:
    """Return the energy of body and wheels in J."""
    body = c.mass * (states[:, 0] ** 2 + states[:, 1] ** 2) + c.yaw_inertia * states[:, 2] ** 2
    wheels = (states[:, -4:] ** 2).sum(axis=1) / c.inverse_spin_inertia
    energy: NDArray[np.float64] = 0.5 * (body + wheels)
    return energy
