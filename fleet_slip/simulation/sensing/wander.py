"""Errors that last: Gauss-Markov processes."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S

KNOT_TICKS = 10
"""Samples between the times for which an error is drawn; in between it is linear."""


class Wander:
    """Processes of mean 0 and standard deviation 1 that forget within a correlation time.

    What they do depends on the generator alone, not on the blocks they come in.
    """

    def __init__(self, count: int, correlation_s: float, generator: np.random.Generator) -> None:
        """Begin at random. A correlation time is long beside the time between draws."""
        decay = 1.0 - KNOT_TICKS * SAMPLE_S / correlation_s
        self._step = (decay, math.sqrt(1.0 - decay * decay))
        self._generator = generator
        self._ends = np.tile(generator.standard_normal(count), (2, 1))
        self._phase = KNOT_TICKS

    def next(self, ticks: int) -> FloatArray:
        """Return the next block, shape (processes, ticks)."""
        knots = (self._phase + ticks - 1) // KNOT_TICKS
        drawn = self._generator.standard_normal((knots, self._ends.shape[1]))
        values = np.empty((self._ends.shape[1], ticks))
        self._phase = _wander(drawn, self._ends, self._phase, self._step, values)
        return values


@kernel
def _wander(
    drawn: FloatArray, ends: FloatArray, phase: int, step: tuple[float, float], values: FloatArray
) -> int:
    """Fill in values, and return the samples since the last knot.

    `ends` holds the processes at the knots before and after, shape (2, processes).
    """
    decay, kick = step
    knot = 0
    for i in range(values.shape[1]):
        if phase == KNOT_TICKS:
            phase = 0
            ends[0] = ends[1]
            ends[1] = decay * ends[1] + kick * drawn[knot]
            knot += 1
        share = phase / KNOT_TICKS
        for j in range(len(values)):
            values[j, i] = ends[0, j] + share * (ends[1, j] - ends[0, j])
        phase += 1
    return phase
