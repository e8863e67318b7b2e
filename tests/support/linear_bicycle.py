"""The linear bicycle of a car, and a car whose steering wheel is turned as prescribed."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S, SPEED_GAIN_1PS
from fleet_slip.vehicle.dynamics import (
    Compliance,
    ComplianceRates,
    Environment,
    cornering_stiffness,
    imperfect_derivative,
)
from fleet_slip.vehicle.integration import (
    FIRST_ORDER,
    SECOND_ORDER,
    STEP_S,
    Slopes,
    advance,
    advance_compliance,
)
from fleet_slip.vehicle.parameters import (
    GRAVITY_MPS2,
    CarImperfections,
    Controls,
    State,
    VehicleParameters,
    constants,
    imperfection_constants,
)


@dataclass(frozen=True)
class LinearBicycle:
    """The linear bicycle of a car at a speed: d/dt (vy, r) = A (vy, r) + b δ.

    Rajamani (2012), 2.3. Compliance softens the front axle: 1 / C = 1 / C_tyres + c.
    """

    wheelbase_m: float
    understeer: float
    """K in rad s²/m: δ = L / R + K ay."""
    matrix: FloatArray
    steering: FloatArray
    speed_mps: float

    @classmethod
    def from_car(
        cls, car: VehicleParameters, speed_mps: float, compliance_rad_per_n: float = 0.0
    ) -> "LinearBicycle":
        """Return the bicycle of a car on a dry road, its tyres loaded as at rest."""
        c = constants(car, 1.0)
        front = 2 * cornering_stiffness(c.static_front, c.stiffness_front, c)
        rear = 2 * cornering_stiffness(c.static_rear, c.stiffness_rear, c)
        front = 1 / (1 / front + compliance_rad_per_n)
        m, inertia, a, b, v = c.mass, c.yaw_inertia, c.front, c.rear, speed_mps
        matrix = np.array(
            [
                [-(front + rear) / (m * v), -(a * front - b * rear) / (m * v) - v],
                [
                    -(a * front - b * rear) / (inertia * v),
                    -(a**2 * front + b**2 * rear) / (inertia * v),
                ],
            ]
        )
        weight = m / (a + b)
        return cls(
            a + b,
            weight * (b / front - a / rear),
            matrix,
            np.array([front / m, a * front / inertia]),
            speed_mps,
        )

    @property
    def yaw_gain_1ps(self) -> float:
        """Steady yaw rate per steering angle, v / (L + K v²)."""
        return self.speed_mps / (self.wheelbase_m + self.understeer * self.speed_mps**2)

    @property
    def characteristic_speed_mps(self) -> float:
        """Speed of the largest yaw gain, √(L / K)."""
        return float(np.sqrt(self.wheelbase_m / self.understeer))

    @property
    def natural_frequency_hz(self) -> float:
        """Undamped frequency of yaw and side-slip, √det A / 2π."""
        return float(np.sqrt(np.linalg.det(self.matrix)) / (2 * np.pi))

    @property
    def damping(self) -> float:
        """Share of the critical damping, −tr A / (2 √det A)."""
        return float(-np.trace(self.matrix) / (2 * np.sqrt(np.linalg.det(self.matrix))))

    def step_response(self, time_s: FloatArray) -> FloatArray:
        """Return vy and r after a step of the steering of 1 rad, (2, n): A⁻¹ (e^{At} − 1) b."""
        values, vectors = np.linalg.eig(self.matrix)
        parts = np.linalg.solve(vectors, self.steering)
        grown = (np.exp(np.outer(values, time_s)) - 1) / values[:, np.newaxis]
        return np.real(vectors @ (grown * parts[:, np.newaxis]))

    def yaw_response(self, frequency_hz: float) -> complex:
        """Return yaw rate per steering angle at a frequency, (jω − A)⁻¹ b."""
        turning = 2j * np.pi * frequency_hz * np.eye(2) - self.matrix
        return complex(np.linalg.solve(turning, self.steering)[1])


STEPS = round(SAMPLE_S / STEP_S)


class Response(NamedTuple):
    """The motion of a car at 100 Hz."""

    time_s: FloatArray
    demand_rad: FloatArray
    """The angle of the steering wheel."""
    yaw_rate_rad_s: FloatArray
    sideslip_rad: FloatArray
    ay_mps2: FloatArray
    vx_mps: FloatArray


@kernel
def _run(
    x: State,
    slopes: Slopes,
    compliance: Compliance,
    rates: ComplianceRates,
    environment: Environment,
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
            d, new = imperfect_derivative(x, u, compliance, environment, c, t)
            if step == 0:
                out[2, i] = d.ay
            x, slopes = advance(x, d, slopes, c, STEP_S, order)
            compliance = advance_compliance(
                compliance, new, rates, x.steering_wheel, t, STEP_S, order
            )
            rates, order = new, SECOND_ORDER
    return out


def steer(
    car: VehicleParameters, flaws: CarImperfections, demand_rad: FloatArray, speed_mps: float
) -> Response:
    """Return what a car does on a flat, dry road under a demand for every 10 ms."""
    c, t = constants(car, 1.0), imperfection_constants(car, flaws, SAMPLE_S)
    x = State(speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *4 * (speed_mps * c.inverse_radius,))
    still = Slopes(*(0.0 for _ in Slopes._fields))
    initial, steady = (
        Compliance(*(0.0 for _ in Compliance._fields)),
        ComplianceRates(*(0.0 for _ in ComplianceRates._fields)),
    )
    warm = Environment(0.0, 0.0, 1.0, 1.0, 0.0, 1.0)
    rate, vy, ay, vx = _run(x, still, initial, steady, warm, c, t, demand_rad, speed_mps)
    time_s = np.arange(len(demand_rad), dtype=np.float64) * SAMPLE_S
    return Response(time_s, demand_rad, rate, np.arctan2(vy, vx), ay, vx)
