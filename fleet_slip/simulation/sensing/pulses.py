"""A wheel speed sensor that counts the pulses of an encoder."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import kernel
from fleet_slip.vehicle.driver import SAMPLE_S


class Pulses:
    """A wheel speed sensor that times the pulses of an encoder's teeth.

    It reports pulses over the time since the last report; without one, at most one just now.
    """

    def __init__(self, places: FloatArray) -> None:
        self._places = places
        self._state = np.zeros(5)
        self._begun = False

    def apply(self, speed_rad_s: FloatArray) -> FloatArray:
        """Return the next block as the sensor reports it."""
        if not self._begun:
            self._state[:] = 0.0, 0.0, 0.0, speed_rad_s[0], speed_rad_s[0]
            self._begun = True
        return _timed_pulses(speed_rad_s, self._places, self._state)


@kernel
def _timed_pulses(speed: FloatArray, places: FloatArray, state: FloatArray) -> FloatArray:
    """Fill in reports; `state`: turned pulses, last pulse, its age, speed before, report."""
    turned, last, since, before, report = state
    count = len(places)
    per_sample = count * SAMPLE_S / (2.0 * math.pi)
    reports = np.empty(len(speed))
    start = last - int(last) % count  # of the turn; a division for every pulse would take longest
    for i in range(len(speed)):
        step = 0.5 * (before + speed[i]) * per_sample
        turned += step
        since += 1.0
        pulse = math.floor(turned)
        while pulse >= start + count:
            start += count
        while pulse < start:
            start -= count
        tooth = int(pulse - start)
        while pulse > last and turned < pulse + places[tooth]:
            pulse -= 1.0
            tooth = tooth - 1 if tooth > 0 else count - 1
        if pulse > last and step > 0.0:
            ago = (turned - pulse - places[tooth]) / step
            report = (pulse - last) / (max(since - ago, 1e-3) * per_sample)
            last, since = pulse, ago
        elif since > 0.0:
            report = min(report, 1.0 / (since * per_sample))
        reports[i] = report
        before = speed[i]
    state[0], state[1], state[2], state[3], state[4] = turned, last, since, before, report
    return reports
