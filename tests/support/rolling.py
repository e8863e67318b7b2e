"""Cars stepped by the package, under constant demands or through whole drives."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation, kernel
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle import batch
from fleet_slip.vehicle.batch import STEPS_PER_SAMPLE, LaneDrive
from fleet_slip.vehicle.dynamics import (
    CALM,
    Compliance,
    Derivative,
    imperfect_derivative,
)
from fleet_slip.vehicle.integration import FIRST_ORDER, SECOND_ORDER, STEP_S, Slopes, advance
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    Constants,
    Controls,
    ImperfectionConstants,
    State,
    constants,
    load_vehicle,
)

SEDAN = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
CAR = constants(SEDAN, adhesion=1.0)
NO_SLOPES = Slopes(*(0.0 for _ in Slopes._fields))


@equation
def derivative(x: State, u: Controls, c: Constants) -> Derivative:
    """Compute the rates of the textbook's car on a flat, even and calm road.

    Parameters and result are as those of `imperfect_derivative`.
    """
    rigid, r = Compliance(x.steering_wheel, 0.0, 0.0, 0.0, 0.0, 0.0), c.radius
    ideal = ImperfectionConstants(
        0.0, 0.0, 0.0, 0.0, 0.0, r, r, r, r, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )
    rates, _ = imperfect_derivative(x, u, rigid, CALM, c, ideal)
    return rates


@kernel
def rates(x: State, u: Controls, c: Constants) -> Derivative:
    return derivative(x, u, c)


@kernel
def _run(x: State, u: Controls, c: Constants, slopes: Slopes, step: float, count: int) -> Any:
    states = np.empty((count + 1, len(x)))
    forces = np.empty((count, 2))
    order = FIRST_ORDER
    for i in range(count):
        for k, value in enumerate(x):
            states[i, k] = value
        d = derivative(x, u, c)
        forces[i, 0], forces[i, 1] = d.ax, d.ay
        x, slopes = advance(x, d, slopes, c, step, order)
        order = SECOND_ORDER
    for k, value in enumerate(x):
        states[count, k] = value
    return states, forces, x


class Run:
    """The solution: `states` (steps + 1, fields), specific forces (steps, 2), the last state."""

    def __init__(
        self, x: State, u: Controls, seconds: float, c: Constants = CAR, step: float = STEP_S
    ) -> None:
        self.states, self.forces, self.last = _run(x, u, c, NO_SLOPES, step, round(seconds / step))

    def __getitem__(self, field: str) -> NDArray[np.float64]:
        """Return the course of one field of the state."""
        column: NDArray[np.float64] = self.states[:, State._fields.index(field)]
        return column


def rolling(vx: float, c: Constants = CAR, **overrides: float) -> State:
    """Return a car that rolls straight ahead without slip, but for what is given."""
    at_rest = State(*(0.0 for _ in State._fields))
    spins = {f"wheel_{wheel}": vx * c.inverse_radius for wheel in ("fl", "fr", "rl", "rr")}
    return at_rest._replace(vx=vx, **{**spins, **overrides})


def holding(vx: float, c: Constants = CAR) -> float:
    """Return the traction that overcomes drag and rolling resistance."""
    return c.drag_per_mass * vx * vx + c.rolling_resistance * GRAVITY_MPS2


def kinetic_energy(states: NDArray[np.float64], c: Constants = CAR) -> NDArray[np.float64]:
    """Return the energy of body and wheels in J."""
    body = c.mass * (states[:, 0] ** 2 + states[:, 1] ** 2) + c.yaw_inertia * states[:, 2] ** 2
    wheels = (states[:, -4:] ** 2).sum(axis=1) / c.inverse_spin_inertia
    energy: NDArray[np.float64] = 0.5 * (body + wheels)
    return energy


class Truth:
    """The motion of one drive at 100 Hz: float64 arrays of one length by `CHANNELS`."""

    def __init__(self, channels: dict[str, FloatArray], lost_control_tick: int | None) -> None:
        self.channels, self.lost_control_tick = channels, lost_control_tick

    def __getattr__(self, name: str) -> FloatArray:
        return self.channels[name]


def simulate_drives(
    drives: Sequence[LaneDrive],
    steps_per_sample: int = STEPS_PER_SAMPLE,
    simulate_lanes: Callable[..., None] = batch.simulate_lanes,
) -> list[Truth]:
    """Return what happens in each drive, in their order."""
    drives_by_end = batch.simulate_drives(drives, steps_per_sample, simulate_lanes)
    truths = {truth.drive: truth for truth in drives_by_end}
    return [
        Truth(truths[drive].channels, truths[drive].lost_control_tick)
        for drive in range(len(drives))
    ]
