"""A car whose steering wheel is turned as prescribed, and whose speed is held."""

from typing import Any, NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S, SPEED_GAIN_1PS
from fleet_slip.vehicle.dynamics import NO_BRAKES, Around, Give, GiveRates, imperfect_derivative
from fleet_slip.vehicle.imperfections import CarImperfections, traits
from fleet_slip.vehicle.integration import (
    FIRST_ORDER,
    SECOND_ORDER,
    STEP_S,
    Slopes,
    advance,
    advance_give,
)
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    Controls,
    State,
    VehicleParameters,
    constants,
)

STEPS = round(SAMPLE_S / STEP_S)


class Response(NamedTuple):
    """What a car did, at 100 Hz."""

    time_s: FloatArray
    demand_rad: FloatArray
    """Of the steering wheel."""
    yaw_rate_rad_s: FloatArray
    sideslip_rad: FloatArray
    ay_mps2: FloatArray
    vx_mps: FloatArray


@kernel
def _run(
    x: State,
    slopes: Slopes,
    give: Give,
    rates: GiveRates,
    around: Around,
    c: Any,
    t: Any,
    demand: FloatArray,
    speed: float,
) -> FloatArray:
    out = np.empty((4, len(demand)))
    order = FIRST_ORDER
    for i in range(len(demand)):
        resistance = c.drag_per_mass * x.vx * x.vx + c.rolling_resistance * GRAVITY_MPS2
        u = Controls(demand[i], resistance - x.vy * x.yaw_rate + SPEED_GAIN_1PS * (speed - x.vx))
        out[0, i], out[1, i], out[3, i] = x.yaw_rate, x.vy, x.vx
        for step in range(STEPS):
            d, new = imperfect_derivative(x, u, give, around, NO_BRAKES, c, t)
            if step == 0:
                out[2, i] = d.ay
            x, slopes = advance(x, d, slopes, c, STEP_S, order)
            give = advance_give(give, new, rates, x.steering_wheel, t, STEP_S, order)
            rates, order = new, SECOND_ORDER
    return out


def steer(
    car: VehicleParameters, flaws: CarImperfections, demand_rad: FloatArray, speed_mps: float
) -> Response:
    """Return what a car does on a flat, dry road under a demand for every 10 ms."""
    c, t = constants(car, 1.0), traits(car, flaws, SAMPLE_S)
    x = State(speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *4 * (speed_mps * c.inverse_radius,))
    still = Slopes(*(0.0 for _ in Slopes._fields))
    rest, steady = Give(*(0.0 for _ in Give._fields)), GiveRates(*(0.0 for _ in GiveRates._fields))
    warm = Around(0.0, 0.0, 1.0, 1.0, 0.0, 1.0)
    rate, vy, ay, vx = _run(x, still, rest, steady, warm, c, t, demand_rad, speed_mps)
    time_s = np.arange(len(demand_rad), dtype=np.float64) * SAMPLE_S
    return Response(time_s, demand_rad, rate, np.arctan2(vy, vx), ay, vx)
