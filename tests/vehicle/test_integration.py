"""The integration scheme: its order, its stability, and that nothing is lost at rest."""

import numpy as np
import pytest

from fleet_slip.vehicle.parameters import Controls
from tests.support.rolling import Run, rolling


def error(step: float) -> float:
    """Largest error of the final state of a hard transient, against a hundredfold finer step."""
    start, demands = rolling(25.0), Controls(1.2, -3.0)
    reference = Run(start, demands, seconds=1.2, step=0.00002).last
    last = Run(start, demands, seconds=1.2, step=step).last
    return float(np.abs(np.subtract(last, reference)).max())


def test_the_scheme_is_of_second_order() -> None:
    ratio = error(0.002) / error(0.001)
    assert 3.3 < ratio < 4.7


def test_stiff_wheels_follow_the_car_without_lag() -> None:
    """At 3 m/s the tyre turns the wheel's speed within a fifth of a step."""
    run = Run(rolling(3.0), Controls(0.0, 2.0), seconds=1.0)
    fine = Run(rolling(3.0), Controls(0.0, 2.0), seconds=1.0, step=0.0002)
    assert np.abs(run["wheel_fl"][::50] - fine["wheel_fl"][::500]).max() < 0.01


@pytest.mark.parametrize("vx", [0.5, 1.5, 2.4, 2.6, 4.0, 8.0])
def test_slow_cars_do_not_oscillate(vx: float) -> None:
    run = Run(rolling(vx, vy=0.1), Controls(0.5, 0.0), seconds=4.0)
    curvature = np.diff(run.states[1500:, :3], n=2, axis=0)
    assert np.abs(curvature).max() < 1e-5
