"""Errors on a logarithmic axis: over noise, by lateral acceleration, car by car."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from fleet_slip.base import FloatArray
from fleet_slip.evaluation.drives import EvaluatedDrive, find_stretches
from fleet_slip.evaluation.evaluate import gates_on
from fleet_slip.evaluation.fleet_cars import Cars
from fleet_slip.evaluation.scenarios import EvaluatedScenario
from fleet_slip.models.manifest import Manifest
from fleet_slip.pages.drawing import POINTS_PER_INCH, SHADES, Size, colour
from fleet_slip.pages.page import degrees
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ

# Series over time: the speed, true and estimated angles, and beneath them the differences.


@dataclass(frozen=True)
class Band:
    """A series in bins of equal length; all arrays have shape (bins,).

    Attributes:
        x: middle of each bin.
        mean: mean of the bin's values; NaN where there is none.
        low, high: its smallest and its largest value.
    """

    x: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def band(x: FloatArray, y: FloatArray, bins: int) -> Band:
    """Cut a series, shape (rows,), into at most so many bins. NaN stands for no value."""
    size = max(1, -(-len(x) // bins))
    count = -(-len(x) // size)
    padded = np.full((2, count * size), np.nan)
    padded[:, : len(x)] = x, y
    xs, ys = padded.reshape(2, count, size)
    finite = np.isfinite(ys)
    none = ~finite.any(axis=1)
    rows = np.maximum(finite.sum(axis=1), 1)
    mean = np.where(finite, ys, 0.0).sum(axis=1) / rows
    low = np.where(finite, ys, np.inf).min(axis=1)
    high = np.where(finite, ys, -np.inf).max(axis=1)
    middle = np.nansum(xs, axis=1) / np.isfinite(xs).sum(axis=1)
    return Band(middle, *(np.where(none, np.nan, values) for values in (mean, low, high)))


def smooth(values: FloatArray, samples: int) -> FloatArray:
    """Return the mean over a window around each sample, shorter at both ends; shape (rows,)."""
    window = np.ones(samples)
    count = np.convolve(np.ones(len(values)), window, mode="same")
    mean: FloatArray = np.convolve(values, window, mode="same") / count
    return mean


TIME_SERIES_ANGLE_IN = 1.75
STRIP_IN = 0.62
TIME_SERIES_GAP_IN = 0.12
TIME_SERIES_HEAD_IN = 0.42
TIME_SERIES_FOOT_IN = 0.42
TIME_SERIES_LEFT_IN = 0.42
TIME_SERIES_RIGHT_IN = 0.08
REACHES_DEG = (0.2, 0.4, 0.6, 1.0, 2.0, 4.0, 6.0, 10.0, 20.0, 40.0, 90.0, 180.0, 360.0)
COMPARABLE = 3
"""Largest ratio of scales at which the smaller one is given up."""


@dataclass(frozen=True)
class Line:
    """One estimator in a figure."""

    estimator: str
    label: str
    colour: str


@dataclass(frozen=True)
class DriveBlock:
    """One drive in a figure.

    Attributes:
        title: what is special about the drive.
        run: the drive with its estimates.
        lines: drawn with the true angle; each also has a strip with its difference.
        strips: more estimators, of which the difference alone is drawn.
        shaded: name of the section to mark.
    """

    title: str
    run: EvaluatedScenario
    lines: tuple[Line, ...]
    strips: tuple[Line, ...] = ()
    shaded: str | None = None

    @property
    def all_strips(self) -> tuple[Line, ...]:
        """All estimators of which the difference is drawn."""
        return (*self.lines, *self.strips)

    @property
    def height_in(self) -> float:
        """Height with its strips, head and foot."""
        return (
            TIME_SERIES_HEAD_IN
            + TIME_SERIES_ANGLE_IN
            + len(self.all_strips) * (STRIP_IN + TIME_SERIES_GAP_IN)
            + TIME_SERIES_FOOT_IN
        )


def side_slip(blocks: Sequence[DriveBlock], size: Size) -> Figure:
    """Draw the blocks one above another."""
    height = sum(block.height_in for block in blocks)
    figure = Figure(figsize=(size.width_in, height))
    top = height
    for block, reach in zip(blocks, _reaches(blocks), strict=True):
        _time_series_draw(figure, block, top, reach, size)
        top -= block.height_in
    return figure


def _time_series_draw(
    figure: Figure, block: DriveBlock, top_in: float, reach: float, size: Size
) -> None:
    angle, *strips = _panels(figure, block, top_in)
    time_s = block.run.drive.time_s
    truth_deg = np.degrees(block.run.drive.sideslip_rad)
    for axes in (angle, *strips):
        axes.set_xlim(time_s[0], time_s[-1])
        shade(axes, block.run, block.shaded)
    for line in block.lines:
        _plot(axes=angle, x=time_s, y=_estimate_deg(block, line), line=line, size=size)
    truth = band(time_s, truth_deg, size.bins)
    angle.plot(truth.x, truth.mean, color=colour("truth"), linewidth=1.1)
    _legend(figure, angle, block, top_in)
    angle.set_ylabel("side-slip angle (deg)" if size.wide else "deg", labelpad=2)
    for axes, line in zip(strips, block.all_strips, strict=True):
        _plot(axes, time_s, _estimate_deg(block, line) - truth_deg, line, size)
        axes.set_ylim(-reach, reach)
        axes.set_yticks([-reach / 2, 0, reach / 2])
        _caption(axes, block, line, size)
    for axes in (angle, *strips[:-1]):
        hide_time(axes)
    last = strips[-1] if strips else angle
    last.set_xlabel("time (s)", labelpad=2)


def _panels(figure: Figure, block: DriveBlock, top_in: float) -> Iterator[Axes]:
    width, height = figure.get_size_inches()
    across = (TIME_SERIES_LEFT_IN / width, 1 - (TIME_SERIES_LEFT_IN + TIME_SERIES_RIGHT_IN) / width)
    bottom = top_in - TIME_SERIES_HEAD_IN - TIME_SERIES_ANGLE_IN
    yield figure.add_axes((across[0], bottom / height, across[1], TIME_SERIES_ANGLE_IN / height))
    for _ in block.all_strips:
        bottom -= TIME_SERIES_GAP_IN + STRIP_IN
        yield figure.add_axes((across[0], bottom / height, across[1], STRIP_IN / height))


def _estimate_deg(block: DriveBlock, line: Line) -> FloatArray:
    drive = block.run.drive
    estimate: FloatArray = np.where(
        drive.evaluated, np.degrees(block.run.estimates[line.estimator]), np.nan
    )
    return estimate


def _plot(axes: Axes, x: FloatArray, y: FloatArray, line: Line, size: Size) -> None:
    series = band(x, y, size.bins)
    tone = colour(line.colour)
    axes.fill_between(series.x, series.low, series.high, color=tone, alpha=0.3, linewidth=0)
    axes.plot(series.x, series.mean, color=tone, linewidth=1.0)


def _reaches(blocks: Sequence[DriveBlock]) -> list[float]:
    """Return the half-height of each block's strips: the same for all where that can be read."""
    reaches = []
    for block in blocks:
        truth = np.degrees(block.run.drive.sideslip_rad)
        sizes = [np.abs(_estimate_deg(block, line) - truth) for line in block.all_strips]
        largest = max(float(np.nanmax(values)) for values in sizes)
        reaches.append(next(reach for reach in REACHES_DEG if largest < reach))
    comparable = max(reaches) <= COMPARABLE * min(reaches)
    return [max(reaches)] * len(reaches) if comparable else reaches


def shade(axes: Axes, run: EvaluatedScenario, shaded: str | None) -> None:
    """Mark the stretches of a section of a drive."""
    for section in run.sections:
        if section.name == shaded:
            tone = colour("unstable" if shaded == "unstable" else "outage")
            for one in find_stretches(run.drive, section.rows):
                axes.axvspan(one.from_s, one.until_s, color=tone, alpha=0.16, linewidth=0)


def hide_time(axes: Axes) -> None:
    """Leave out the axis of time, which stands beneath another strip."""
    axes.tick_params(labelbottom=False, bottom=False)
    axes.spines["bottom"].set_visible(False)


def _legend(figure: Figure, axes: Axes, block: DriveBlock, top_in: float) -> None:
    """Write the title, and beneath it the name of each line in its colour."""
    width, height = figure.get_size_inches()
    figure.text(
        TIME_SERIES_LEFT_IN / width,
        (top_in - 0.05) / height,
        block.title,
        fontweight="bold",
        va="top",
    )
    names = [("true", "truth"), *((line.label, line.colour) for line in block.lines)]
    if block.shaded and any(section.name == block.shaded for section in block.run.sections):
        shade = ("unstable", "unstable") if block.shaded == "unstable" else ("no GPS", "outage")
        names.append(shade)
    left = TIME_SERIES_LEFT_IN
    for name, tone in names:
        figure.text(
            left / width,
            (top_in - 0.24) / height,
            f"\N{EM DASH} {name}"
            if tone not in ("unstable", "outage")
            else f"\N{BLACK SQUARE} {name}",
            color=colour(tone),
            va="top",
        )
        left += 0.07 * (len(name) + 3.5)
    axes.margins(y=0.06)


def _caption(axes: Axes, block: DriveBlock, line: Line, size: Size) -> None:
    figures = block.run.results[line.estimator].whole
    text = f"{line.label} \N{MINUS SIGN} true"
    if figures.error_std_deg is not None and figures.error_mean_deg is not None:
        std, mean = degrees(figures.error_std_deg), degrees(figures.error_mean_deg, sign=True)
        text += f": std {std}, mean {mean}" if size.wide else f": std {std}"
    axes.text(
        0.0,
        1.0,
        text,
        transform=axes.transAxes,
        color=colour(line.colour),
        fontsize=8.5,
        va="center",
        bbox={"facecolor": colour("surface"), "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
    )


TIME_SERIES_HEIGHT_IN = 2.0
KMH_PER_MPS = 3.6


def speed(drive: EvaluatedDrive, size: Size) -> Figure:
    """Draw the true speed of a drive."""
    figure = Figure(figsize=(size.width_in, TIME_SERIES_HEIGHT_IN))
    axes = figure.add_axes(
        (
            0.42 / size.width_in,
            0.42 / TIME_SERIES_HEIGHT_IN,
            1 - 0.5 / size.width_in,
            1.32 / TIME_SERIES_HEIGHT_IN,
        )
    )
    kmh = drive.speed_mps * KMH_PER_MPS
    series = band(drive.time_s, kmh, size.bins)
    axes.plot(series.x, series.mean, color=colour("model_4"), linewidth=1.3)
    axes.set_xlim(drive.time_s[0], drive.time_s[-1])
    axes.set_ylim(0, 1.05 * float(kmh.max()))
    axes.set_xlabel("time (s)", labelpad=2)
    axes.set_title("speed (km/h)", color=colour("muted"))
    return figure


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


# Every estimator on every test drive.

ROW_IN = 0.19
HEAD_IN = 0.5
FOOT_IN = 0.4
NAMES_IN = 1.6
RIGHT_IN = 0.15
OTHERS = "others"


@dataclass(frozen=True)
class Named:
    """An estimator that has a colour and a name of its own."""

    estimator: str
    label: str
    colour: str


def points_by_drive(
    errors: Mapping[str, Mapping[str, float]], named: Sequence[Named], size: Size
) -> Figure:
    """Draw RMSE in deg by drive and estimator, on a logarithmic axis; the nameless in grey."""
    height = HEAD_IN + len(errors) * ROW_IN + FOOT_IN
    figure = Figure(figsize=(size.width_in, height))
    axes = figure.add_axes(
        (
            NAMES_IN / size.width_in,
            FOOT_IN / height,
            1 - (NAMES_IN + RIGHT_IN) / size.width_in,
            len(errors) * ROW_IN / height,
        )
    )
    known = {one.estimator for one in named}
    rows = [(place, found) for place, found in enumerate(errors.values())]
    rest = [(rmse, p) for p, found in rows for n, rmse in found.items() if n not in known]
    if rest:
        axes.plot(*zip(*rest, strict=True), "|", color=colour("outage"), markersize=6, label=OTHERS)
    for one in reversed(named):
        own = [(found[one.estimator], p) for p, found in rows if one.estimator in found]
        if own:
            axes.plot(*zip(*own, strict=True), "o", color=colour(one.colour), markersize=4.5,
                      label=one.label)  # fmt: skip
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = TICKS_DEG if size.wide else (0.01, 0.1, 1, 10)
    shown = [tick for tick in ticks if low <= tick <= high]
    axes.set_xticks(shown, [f"{tick:g}°" for tick in shown])
    axes.minorticks_off()
    axes.grid(visible=True, axis="both")
    axes.set_yticks(range(len(errors)), list(errors), color=colour("ink"))
    axes.set_ylim(len(errors) - 0.5, -0.5)
    axes.set_xlabel("root mean square error", labelpad=2)
    marks, labels = axes.get_legend_handles_labels()
    figure.legend(
        marks[::-1], labels[::-1], loc="upper left", ncols=5 if size.wide else 2, frameon=False,
        fontsize=9 if size.wide else 7.5, handletextpad=0.2, columnspacing=1.2, borderaxespad=0.2,
    )  # fmt: skip
    return figure


# Draws how far the gates of a model are open on a test drive.


def opening(manifest: Manifest, run: EvaluatedScenario) -> Mapping[str, FloatArray]:
    """Return how far each gate is open on a test drive; see `gates_on`."""
    return gates_on(manifest, run.drive.signals, run.drive.facts)


ANGLE_IN = 2.0
GATE_IN = 0.75
GATE_STRIPS_HEAD_IN = 0.4
GAP_IN = 0.3
GATE_STRIPS_FOOT_IN = 0.45
LEFT_IN = 0.5
GATE_STRIPS_RIGHT_IN = 0.1


def angle_and_gates(
    run: EvaluatedScenario, line: Line, gates: Mapping[str, FloatArray], size: Size
) -> Figure:
    """Draw the true and the estimated angle, and beneath them how far each gate is open."""
    height = GATE_STRIPS_HEAD_IN + ANGLE_IN + len(gates) * (GAP_IN + GATE_IN) + GATE_STRIPS_FOOT_IN
    figure = Figure(figsize=(size.width_in, height))
    across = (LEFT_IN / size.width_in, 1 - (LEFT_IN + GATE_STRIPS_RIGHT_IN) / size.width_in)
    top = height - GATE_STRIPS_HEAD_IN
    time_s = run.drive.time_s
    panels = [figure.add_axes((across[0], (top - ANGLE_IN) / height, across[1], ANGLE_IN / height))]
    top -= ANGLE_IN
    for _ in gates:
        top -= GAP_IN + GATE_IN
        panels.append(figure.add_axes((across[0], top / height, across[1], GATE_IN / height)))
    for axes in panels:
        axes.set_xlim(time_s[0], time_s[-1])
        shade(axes, run, "unstable")
    angle, *strips = panels
    for tone, values in (
        ("truth", run.drive.sideslip_rad),
        (line.colour, run.estimates[line.estimator]),
    ):
        shown = band(time_s, np.where(run.drive.evaluated, np.degrees(values), np.nan), size.bins)
        angle.plot(shown.x, shown.mean, color=colour(tone), linewidth=1.1)
    angle.set_ylabel("deg", labelpad=2)
    angle.set_title(
        f"side-slip angle: true, and by {line.label} (in colour)", color=colour("muted")
    )
    for axes, (name, open_share) in zip(strips, gates.items(), strict=True):
        shown = band(time_s, open_share, size.bins)
        axes.fill_between(
            shown.x, 0, shown.mean, color=colour(line.colour), alpha=0.35, linewidth=0
        )
        axes.set_ylim(0, 1)
        axes.set_yticks([0, 1])
        axes.set_title(f"gate by {name}", color=colour("muted"))
    for axes in panels[:-1]:
        hide_time(axes)
    panels[-1].set_xlabel("time (s)", labelpad=2)
    return figure


# A map of the track, coloured by the estimator's error.


EDGES_DEG = (0.1, 0.3, 1.0)
"""Sizes of errors at which the colour changes."""

WIDTHS = (4.4, 3.6, 3.0, 2.4, 3.0, 3.6, 4.4)
SPACING_M = 3.0
SCALE_BAR_M = 200.0
KEY_IN = 0.62
TRACK_MAP_HEAD_IN = 0.3


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
    tall_in = 0.68 * each_in + TRACK_MAP_HEAD_IN
    height = rows * tall_in + KEY_IN
    figure = Figure(figsize=(size.width_in, height))
    for i, one in enumerate(maps):
        left, below = (i % columns) / columns, height - (i // columns + 1) * tall_in
        figure.text(
            left + 0.02, (below + tall_in - 0.04) / height, one.title, fontweight="bold", va="top"
        )
        axes = figure.add_axes(
            (
                left + 0.02,
                below / height,
                1 / columns - 0.04,
                (tall_in - TRACK_MAP_HEAD_IN) / height,
            )
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
