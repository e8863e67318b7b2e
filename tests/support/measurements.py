"""Measurements of a simulated drive."""

from collections.abc import Mapping

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.simulation.sensors import Measurement, Recorder, Sensors
from tests.support.catalog import SIGNALS


def measure(
    truth: Mapping[str, FloatArray], sensors: Sensors, generator: np.random.Generator
) -> Measurement:
    """Measure one drive in one block; see `Recorder`."""
    recorder = Recorder(SIGNALS, sensors, generator)
    recorder.record(truth)
    return recorder.measurement()
