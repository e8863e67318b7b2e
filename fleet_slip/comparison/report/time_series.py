"""Series over time: the speed, true and estimated angles, and beneath them the differences."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.comparison.evaluation.unstable import find_stretches
from fleet_slip.pages.drawing import Size, colour
from fleet_slip.pages.page_parts import degrees


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


ANGLE_IN = 1.75
STRIP_IN = 0.62
GAP_IN = 0.12
HEAD_IN = 0.42
FOOT_IN = 0.42
LEFT_IN = 0.42
RIGHT_IN = 0.08
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
        return HEAD_IN + ANGLE_IN + len(self.all_strips) * (STRIP_IN + GAP_IN) + FOOT_IN


def side_slip(blocks: Sequence[DriveBlock], size: Size) -> Figure:
    """Draw the blocks one above another."""
    height = sum(block.height_in for block in blocks)
    figure = Figure(figsize=(size.width_in, height))
    top = height
    for block, reach in zip(blocks, _reaches(blocks), strict=True):
        _draw(figure, block, top, reach, size)
        top -= block.height_in
    return figure


def _draw(figure: Figure, block: DriveBlock, top_in: float, reach: float, size: Size) -> None:
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
    across = (LEFT_IN / width, 1 - (LEFT_IN + RIGHT_IN) / width)
    bottom = top_in - HEAD_IN - ANGLE_IN
    yield figure.add_axes((across[0], bottom / height, across[1], ANGLE_IN / height))
    for _ in block.all_strips:
        bottom -= GAP_IN + STRIP_IN
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
    figure.text(LEFT_IN / width, (top_in - 0.05) / height, block.title, fontweight="bold", va="top")
    names = [("true", "truth"), *((line.label, line.colour) for line in block.lines)]
    if block.shaded and any(section.name == block.shaded for section in block.run.sections):
        shade = ("unstable", "unstable") if block.shaded == "unstable" else ("no GPS", "outage")
        names.append(shade)
    left = LEFT_IN
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


HEIGHT_IN = 2.0
KMH_PER_MPS = 3.6


def speed(drive: EvaluatedDrive, size: Size) -> Figure:
    """Draw the true speed of a drive."""
    figure = Figure(figsize=(size.width_in, HEIGHT_IN))
    axes = figure.add_axes(
        (0.42 / size.width_in, 0.42 / HEIGHT_IN, 1 - 0.5 / size.width_in, 1.32 / HEIGHT_IN)
    )
    kmh = drive.speed_mps * KMH_PER_MPS
    series = band(drive.time_s, kmh, size.bins)
    axes.plot(series.x, series.mean, color=colour("model_4"), linewidth=1.3)
    axes.set_xlim(drive.time_s[0], drive.time_s[-1])
    axes.set_ylim(0, 1.05 * float(kmh.max()))
    axes.set_xlabel("time (s)", labelpad=2)
    axes.set_title("speed (km/h)", color=colour("muted"))
    return figure
