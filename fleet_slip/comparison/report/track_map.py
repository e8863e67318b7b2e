"""A map of the track, coloured by the estimator's error."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.comparison.report.time_series import smooth
from fleet_slip.pages.drawing import SHADES, Size, colour
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ

SMOOTHED_S = 0.5
"""Noise of single samples would hide where the error is."""

EDGES_DEG = (0.1, 0.3, 1.0)
"""Sizes of errors at which the colour changes."""

WIDTHS = (4.4, 3.6, 3.0, 2.4, 3.0, 3.6, 4.4)
SPACING_M = 3.0
SCALE_BAR_M = 200.0
KEY_IN = 0.62
HEAD_IN = 0.3


def car_positions(drive: EvaluatedDrive) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the car in m, shape (ticks,): along the centre line, and off it."""
    line = drive.scenario.track.centre_line(SPACING_M)
    x, y, heading = (
        np.interp(drive.station_m, line.station_m, values)
        for values in (line.x_m, line.y_m, line.heading_rad)
    )
    offset = drive.lateral_offset_m
    return x - offset * np.sin(heading), y + offset * np.cos(heading)


@dataclass(frozen=True)
class Map:
    """One map of a figure: its title, the drive, and whose error is drawn."""

    title: str
    run: EvaluatedScenario
    estimator: str


def error_map(maps: Sequence[Map], size: Size, edges_deg: Sequence[float] = EDGES_DEG) -> Figure:
    """Draw the maps, side by side where there is room."""
    edges = (*(-edge for edge in reversed(edges_deg)), *edges_deg)
    columns = len(maps) if size.wide else 1
    rows = -(-len(maps) // columns)
    each_in = size.width_in / columns
    tall_in = 0.68 * each_in + HEAD_IN
    height = rows * tall_in + KEY_IN
    figure = Figure(figsize=(size.width_in, height))
    for i, one in enumerate(maps):
        left, below = (i % columns) / columns, height - (i // columns + 1) * tall_in
        figure.text(
            left + 0.02, (below + tall_in - 0.04) / height, one.title, fontweight="bold", va="top"
        )
        axes = figure.add_axes(
            (left + 0.02, below / height, 1 / columns - 0.04, (tall_in - HEAD_IN) / height)
        )
        _draw(axes, one, edges)
    _key(figure, size, edges)
    return figure


def _draw(axes: Axes, one: Map, edges: Sequence[float]) -> None:
    run = one.run
    x, y = car_positions(run.drive)
    error = np.degrees(run.estimates[one.estimator] - run.drive.sideslip_rad)
    error = smooth(error, int(SMOOTHED_S * SAMPLE_RATE_HZ))
    shown = np.isfinite(error) & run.drive.evaluated
    classes = np.digitize(error, edges)
    kinds = np.where(shown, classes, -1)
    for kind, name in enumerate(SHADES):
        lines = [np.column_stack([x[part], y[part]]) for part in _stretches(kinds, kind, run.drive)]
        axes.add_collection(
            LineCollection(lines, colors=colour(name), linewidths=WIDTHS[kind], capstyle="round")
        )
    axes.plot(x[0], y[0], marker="o", color=colour("ink"), markersize=4)
    axes.annotate("start", (x[0], y[0]), xytext=(6, 5), textcoords="offset points", fontsize=8.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.margins(0.06)
    _scale_bar(axes, float(x.max()) - SCALE_BAR_M, float(y.min() - 0.1 * np.ptp(y)))
    axes.set_axis_off()


def _stretches(kinds: FloatArray, kind: int, drive: EvaluatedDrive) -> Iterator[slice]:
    """Yield the samples of each stretch of one class, a few metres apart, joined to the next."""
    edges = np.flatnonzero(np.diff(kinds == kind, prepend=False, append=False))
    metre = np.median(drive.speed_mps) / SAMPLE_RATE_HZ
    step = max(1, int(SPACING_M / metre))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(begin, min(end + step, len(kinds)), step)


def _scale_bar(axes: Axes, left_m: float, bottom_m: float) -> None:
    axes.plot([left_m, left_m + SCALE_BAR_M], [bottom_m] * 2, color=colour("muted"), linewidth=1.2)
    axes.annotate(
        f"{SCALE_BAR_M:.0f} m",
        (left_m, bottom_m),
        xytext=(0, 4),
        textcoords="offset points",
        color=colour("muted"),
        fontsize=8.5,
    )


def _key(figure: Figure, size: Size, edges: Sequence[float]) -> None:
    """Draw what the colours mean, along the lower edge."""
    width, height = figure.get_size_inches()
    margin, each = 0.15, min(0.95, (size.width_in - 0.3) / len(SHADES))
    for i, (name, thickness) in enumerate(zip(SHADES, WIDTHS, strict=True)):
        axes = figure.add_axes(
            ((margin + i * each) / width, 0.34 / height, each / width, 0.1 / height)
        )
        axes.axhline(0, color=colour(name), linewidth=thickness)
        axes.set_axis_off()
    for i, edge in enumerate(edges, start=1):
        figure.text(
            (margin + i * each) / width,
            0.29 / height,
            f"{edge:+g}°".replace("-", "\N{MINUS SIGN}"),
            ha="center",
            va="top",
            fontsize=8,
            color=colour("muted"),
        )
    figure.text(
        margin / width,
        0.5 / height,
        f"estimate \N{MINUS SIGN} true, mean over {SMOOTHED_S:g} s",
        fontsize=8.5,
        color=colour("muted"),
    )
