"""Signals that come late, by a delay or a low-pass, and errors that last (Gauss-Markov)."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S


class Delay:
    """A signal that comes late; between samples it is linear, before the first one constant."""

    def __init__(self, latency_s: float) -> None:
        self._ticks = latency_s / SAMPLE_S
        self._before: FloatArray | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, delayed."""
        if self._ticks == 0.0:
            return values
        whole = math.floor(self._ticks)
        if self._before is None:
            self._before = np.full(whole + 1, values[0])
        return _delayed(values, self._before, self._ticks - whole)


class LowPass:
    """A low-pass of first order, by the trapezoidal rule."""

    def __init__(self, bandwidth_hz: float) -> None:
        """Take the frequency at which the gain is −3 dB; 0 for no low-pass."""
        half = math.pi * bandwidth_hz * SAMPLE_S
        self._gain = half / (1 + half)
        self._last: tuple[float, float] | None = None

    def apply(self, values: FloatArray) -> FloatArray:
        """Return the next block, filtered."""
        if self._gain == 0.0:
            return values
        before, output = self._last or (values[0], values[0])
        filtered = _low_pass(values, float(before), float(output), self._gain)
        self._last = (values[-1], filtered[-1])
        return filtered


@kernel
def _delayed(values: FloatArray, before: FloatArray, part: float) -> FloatArray:
    """Return values `len(before) - 1 + part` samples late; `before` is the last block's end."""
    first, ticks = len(before), len(values)
    late = np.empty(ticks)
    for i in range(min(first, ticks)):
        newer = before[i + 1] if i + 1 < first else values[i + 1 - first]
        late[i] = (1.0 - part) * newer + part * before[i]
    for i in range(first, ticks):
        late[i] = (1.0 - part) * values[i + 1 - first] + part * values[i - first]
    if ticks < first:
        before[: first - ticks] = before[ticks:].copy()
        before[first - ticks :] = values
    else:
        before[:] = values[ticks - first :]
    return late


@kernel
def _low_pass(values: FloatArray, before: float, output: float, gain: float) -> FloatArray:
    filtered = np.empty(len(values))
    for i in range(len(values)):
        output += gain * (values[i] + before - 2.0 * output)
        before = values[i]
        filtered[i] = output
    return filtered


KNOT_TICKS = 10
"""Samples between the times for which an error is drawn; in between it is linear."""


class Wander:
    """Processes of mean 0 and deviation 1 that forget within a correlation time, block or not."""

    def __init__(self, count: int, correlation_s: float, generator: np.random.Generator) -> None:
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
    """Fill in values between the knots `ends`, shape (2, processes); return how far they reach."""
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
