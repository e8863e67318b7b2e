"""Measurements of a simulated drive."""

from collections.abc import Mapping

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.simulation import sensors as simulated
from fleet_slip.simulation.sensors import Measurement, Sensors
from tests.support.catalog import SIGNALS


def measure(
    truth: Mapping[str, FloatArray], sensors: Sensors, generator: np.random.Generator
) -> Measurement:
    """Measure one drive with the signals of the package."""
    return simulated.measure(SIGNALS, sensors, generator, truth)
