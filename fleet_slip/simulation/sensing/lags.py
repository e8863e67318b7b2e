"""Signals that come late: a delay, and a low-pass. Both remember the block before."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S


class Delay:
    """A signal that comes late; between samples it is linear, before the first one constant."""

    def __init__(self, latency_s: float) -> None:
        """Take the latency."""
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
    """Return values that are late by `len(before) - 1 + part` samples.

    `before` holds the last values of the block before, and then of this one.
    """
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
