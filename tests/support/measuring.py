"""Sensors that measure a drive in one block, or without noise."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import Signal
from fleet_slip.simulation.sensors import EXACT, Measurement, Recorder, Sensors, noisy_counts


def measure(
    truth: Mapping[str, FloatArray], sensors: Sensors, generator: np.random.Generator
) -> Measurement:
    """Measure one drive in one block; see `Recorder`."""
    recorder = Recorder(sensors, generator)
    recorder.record(truth)
    return recorder.measurement()


def quantise(physical: FloatArray, signal: Signal) -> tuple[NDArray[np.int16], int]:
    """Return `physical / scale` as counts, and how many values were clipped to the valid range.

    Halves round to even. NaN is clipped as well, to the lower end.
    """
    return noisy_counts(physical, np.zeros(len(physical), dtype=np.float32), EXACT, signal)
