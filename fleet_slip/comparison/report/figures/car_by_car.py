"""The error in each car of a fleet, before and after calibration."""

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.comparison.report.figures.labels import End, error_axes, finish_errors
from fleet_slip.comparison.report.findings.own_numbers import Cars
from fleet_slip.pages.style import Size, colour

BEFORE, AFTER = "kalman", "model_3"


def car_by_car(cars: Cars, size: Size) -> Figure:
    """Draw a point for each car without its numbers and one with them, in the order of the first.

    Dashed lines are the errors over all rows.
    """
    axes = error_axes(size)
    places = np.arange(1, len(cars.before_deg) + 1)
    axes.vlines(places, cars.before_deg, cars.after_deg, color=colour("grid"), linewidth=0.8)
    ends = []
    for label, tone, each, overall in (
        ("without its numbers", BEFORE, cars.before_deg, cars.all_before_deg),
        ("with its numbers", AFTER, cars.after_deg, cars.all_after_deg),
    ):
        axes.plot(places, each, "o", color=colour(tone), markersize=2.4, linewidth=0)
        axes.axhline(overall, color=colour(tone), linewidth=1.0, linestyle=(0, (5, 3)))
        ends.append(End(overall, label, tone))
    axes.set_xlim(0, len(places) + 1)
    return finish_errors(axes, "cars, by their error without", ends, size)
