"""The linear bicycle of a car: closed forms that a simulation must come near."""

from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.vehicle.tyre import cornering_stiffness


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
    def of(
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
