"""What an uneven road adds to accelerations and wheel speeds.

ISO 8608: height has a power spectral density Gd (n0 / n)², n0 = 0.1 cycles/m, so that a wheel's
vertical velocity is white noise, of density (2π n0)² Gd v. Body and wheels answer as oscillators.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

BODY = (1.5, 0.3)
"""Natural frequency in Hz and damping of a body's roll and pitch on its springs."""

WHEEL = (12.0, 0.15)
"""Of a wheel on its tyre (both: Mitschke and Wallentowitz 2014; Gillespie 1992, ch. 5)."""

TRACK_M, WHEELBASE_M, RADIUS_M = 1.5, 2.7, 0.32

UNIT_ABOVE_ROLL_AXIS_M = 0.3

AX, AY, FIRST_WHEEL = range(3)


class Vibration:
    """The vibration of one drive."""

    def __init__(self, roughness_cm3: float, generator: np.random.Generator) -> None:
        density = (2 * math.pi * 0.1) ** 2 * roughness_cm3 * 1e-6 / (2 * SAMPLE_S)
        body_1ps = 2 * math.pi * BODY[0]
        per_rad = GRAVITY_MPS2 + body_1ps**2 * UNIT_ABOVE_ROLL_AXIS_M  # it leans, and swings
        gains = [per_rad / WHEELBASE_M, per_rad / TRACK_M, *4 * (1 / (3 * RADIUS_M),)]
        self._gains = math.sqrt(density) * np.array(gains)
        self._oscillators = np.array([_oscillator(*kind) for kind in (BODY, BODY, *4 * (WHEEL,))])
        self._state = np.zeros((len(gains), 2))
        self._generator = generator

    def next(self, speed_mps: FloatArray) -> FloatArray:
        """Return ax and ay in m/s², and what wheel speeds change by, relative; (6, ticks)."""
        shape = (len(self._gains), len(speed_mps))
        noise = self._generator.standard_normal(shape, dtype=np.float32)
        return _answer(
            noise, np.sqrt(np.abs(speed_mps)), self._oscillators, self._state, self._gains
        )


def _oscillator(frequency_hz: float, damping: float) -> tuple[float, ...]:
    """Return the filter (b0, b1, b2, a1, a2) from the road's velocity to what a spring gives.

    −(s + b) / (s² + b s + ω²), b = 2 ζ ω, by the trapezoidal rule, s = k (1 − z⁻¹) / (1 + z⁻¹).
    """
    k, omega = 2 / SAMPLE_S, 2 * math.pi * frequency_hz
    b = 2 * damping * omega
    whole = k * k + b * k + omega * omega
    top = (-(k + b), -2 * b, k - b)
    below = (2 * (omega * omega - k * k), k * k - b * k + omega * omega)
    return *(one / whole for one in top), *(one / whole for one in below)


@kernel
def _answer(
    noise: NDArray[np.float32],
    swell: FloatArray,
    oscillators: FloatArray,
    state: FloatArray,
    gains: FloatArray,
) -> FloatArray:
    """Return what oscillators make of noise that swells with the speed; keep their state."""
    values = np.empty(noise.shape)
    for j in range(len(noise)):
        b0, b1, b2, a1, a2 = oscillators[j]
        first, second = state[j]
        for i in range(len(swell)):
            pushed = gains[j] * swell[i] * noise[j, i]
            value = b0 * pushed + first
            first = b1 * pushed - a1 * value + second
            second = b2 * pushed - a2 * value
            values[j, i] = value
        state[j, 0], state[j, 1] = first, second
    return values
