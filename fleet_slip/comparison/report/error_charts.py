"""Errors on a logarithmic axis: over noise, by lateral acceleration, car by car."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.comparison.report.fleet_cars import Cars
from fleet_slip.comparison.report.time_series import Line, smooth
from fleet_slip.pages.drawing import POINTS_PER_INCH, Size, colour
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ

LINE_POINTS = 13.0
"""Height of a line of text."""

HEIGHT_IN = 3.6
TICKS_DEG = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)


@dataclass(frozen=True)
class End:
    """The right end of a line: its value, name and colour."""

    value: float
    label: str
    colour: str


def error_axes(
    size: Size, height_in: float = HEIGHT_IN, room_in: tuple[float, float] = (1.5, 1.05)
) -> Axes:
    """Return axes for errors, with room for names at the right: on wide and on narrow pages."""
    figure = Figure(figsize=(size.width_in, height_in))
    room = room_in[0] if size.wide else room_in[1]
    width = 1 - (0.5 + room) / size.width_in
    return figure.add_axes((0.5 / size.width_in, 0.45 / height_in, width, 1 - 0.8 / height_in))


def finish_errors(axes: Axes, label: str, ends: Sequence[End], size: Size) -> Figure:
    """Make the errors' axis logarithmic, and name axes and lines; return the figure."""
    axes.set_yscale("log")
    tick_degrees(axes)
    axes.set_xlabel(label, labelpad=2)
    axes.set_title("root mean square error", color=colour("muted"))
    label_ends(axes, ends, size)
    return cast(Figure, axes.figure)


def tick_degrees(axes: Axes) -> None:
    """Mark round angles on the logarithmic vertical axis."""
    low, high = axes.get_ylim()
    shown = [tick for tick in TICKS_DEG if low <= tick <= high]
    axes.set_yticks(shown, [f"{tick:g}°" for tick in shown])
    axes.minorticks_off()


def label_ends(axes: Axes, ends: Sequence[End], size: Size) -> None:
    """Write each line's name at its right end, on a logarithmic axis, apart to be read."""
    low, high = np.log(axes.get_ylim())
    pixels = axes.get_window_extent().height
    least = LINE_POINTS / (pixels * POINTS_PER_INCH / axes.figure.dpi)
    ordered = sorted(ends, key=lambda end: end.value)
    places = apart([(np.log(end.value) - low) / (high - low) for end in ordered], least)
    for place, end in zip(places, ordered, strict=True):
        axes.text(
            1.01,
            place,
            end.label,
            transform=axes.transAxes,
            color=colour(end.colour),
            va="center",
            fontsize=9 if size.wide else 8,
        )


def apart(places: Sequence[float], least: float) -> list[float]:
    """Move ascending places at most 1 apart by at least so much, up first, then down from 1."""
    moved = list(places)
    for i in range(1, len(moved)):
        moved[i] = max(moved[i], moved[i - 1] + least)
    moved[-1] = min(moved[-1], 1.0)
    for i in reversed(range(len(moved) - 1)):
        moved[i] = min(moved[i], moved[i + 1] - least)
    return moved


BEFORE, AFTER = "kalman", "model_3"


def car_by_car(cars: Cars, size: Size) -> Figure:
    """Draw a point a car without its numbers and one with them; dashed are all rows together."""
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


@dataclass(frozen=True)
class Series:
    """RMSE in deg at each place, shape (places,)."""

    label: str
    colour: str
    rmse_deg: FloatArray


def error_over(places: FloatArray, label: str, lines: Sequence[Series], size: Size) -> Figure:
    """Draw each line over some places, shape (places,), on a logarithmic scale."""
    axes = error_axes(size)
    for line in lines:
        tone = colour(line.colour)
        axes.plot(
            places[: len(line.rmse_deg)],
            line.rmse_deg,
            color=tone,
            linewidth=1.6,
            marker="o",
            markersize=3,
        )
    return finish_errors(
        axes, label, [End(float(o.rmse_deg[-1]), o.label, o.colour) for o in lines], size
    )


BIN_MPS2 = 0.5
LEAST_ROWS = 200
SMOOTHED_S = 0.5


def lateral_acceleration(run: EvaluatedScenario) -> FloatArray:
    """Return |ay| in m/s² at each tick: the sensor's, less its stated bias, smoothed."""
    ay = run.drive.signals["ay_mps2"] - run.drive.scenario.sensors.ay_bias_mps2
    return np.abs(smooth(ay, int(SMOOTHED_S * SAMPLE_RATE_HZ)))


def error_by_bin(
    runs: Sequence[EvaluatedScenario], estimator: str
) -> tuple[FloatArray, FloatArray]:
    """Return the middle of each bin in m/s² and the root mean square error in it, in deg."""
    acceleration = np.concatenate([lateral_acceleration(run) for run in runs])
    error = np.concatenate(
        [
            np.where(
                run.drive.evaluated,
                np.degrees(run.estimates[estimator] - run.drive.sideslip_rad),
                np.nan,
            )
            for run in runs
        ]
    )
    given = np.isfinite(error) & np.isfinite(acceleration)
    place = (acceleration[given] / BIN_MPS2).astype(int)
    rows = np.bincount(place)
    squares = np.bincount(place, weights=error[given] ** 2)
    kept = np.flatnonzero(rows >= LEAST_ROWS)
    middle = ((kept + 0.5) * BIN_MPS2).astype(np.float64)
    return middle, np.sqrt(squares[kept] / rows[kept]).astype(np.float64)


def error_by_acceleration(
    runs: Sequence[EvaluatedScenario], lines: Sequence[Line], trained_to_mps2: float, size: Size
) -> Figure:
    """Draw the error of each estimator over the lateral acceleration, on a logarithmic scale."""
    axes = error_axes(size, 3.3, (1.35, 0.95))
    ends, furthest = [], 0.0
    for line in lines:
        middle, error = error_by_bin(runs, line.estimator)
        axes.plot(middle, error, color=colour(line.colour), linewidth=1.6, marker="o", markersize=3)
        furthest = max(furthest, float(middle[-1]))
        ends.append(End(float(error[-1]), line.label, line.colour))
    axes.axvspan(0, trained_to_mps2, color=colour("model_4"), alpha=0.07, linewidth=0)
    axes.text(
        trained_to_mps2,
        1.0,
        "training drives " if size.wide else "training ",
        transform=axes.get_xaxis_transform(),
        ha="right",
        va="top",
        color=colour("muted"),
        fontsize=8.5,
    )
    axes.set_xlim(0, furthest + BIN_MPS2 / 2)
    return finish_errors(axes, "size of the lateral acceleration (m/s²)", ends, size)
