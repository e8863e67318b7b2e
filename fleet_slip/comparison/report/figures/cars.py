"""The error in each car of a fleet, before and after calibration."""

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.comparison.report.figures.labels import End, label_ends, tick_degrees
from fleet_slip.comparison.report.findings.cars import Cars
from fleet_slip.pages.style import Size, colour

HEIGHT_IN = 3.6
BEFORE, AFTER = "kalman", "model_3"


def car_by_car(cars: Cars, size: Size) -> Figure:
    """Draw a point for each car without its numbers and one with them, in the order of the first.

    Dashed lines are the errors over all rows.
    """
    figure = Figure(figsize=(size.width_in, HEIGHT_IN))
    room = 1.5 if size.wide else 1.05
    axes = figure.add_axes(
        (
            0.5 / size.width_in,
            0.45 / HEIGHT_IN,
            1 - (0.5 + room) / size.width_in,
            1 - 0.8 / HEIGHT_IN,
        )
    )
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
    axes.set_yscale("log")
    axes.set_xlim(0, len(places) + 1)
    tick_degrees(axes)
    axes.set_xlabel("cars, by their error without", labelpad=2)
    axes.set_title("root mean square error", color=colour("muted"))
    label_ends(axes, ends, size)
    return figure
