"""The paper's figures, in its order: angles and speed over time, captions from the same data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Patch

from fleet_slip.arrays import FloatArray
from fleet_slip.evaluation.evaluator import EvaluatedDrive
from fleet_slip.evaluation.report_data import DRAWN_FILTERS, ReportData
from fleet_slip.evaluation.test_drives import Section, TestDrive, find_stretches
from fleet_slip.pages.drawing import BINS, WIDTH_IN, Picture, colour
from fleet_slip.pages.page import degrees, join_words, number


@dataclass(frozen=True)
class Band:
    """Middle x, mean, smallest and largest value of equal bins, shape (bins,); NaN without any."""

    x: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def band(x: FloatArray, y: FloatArray, bins: int) -> Band:
    """Cut a series, shape (rows,), into at most `bins` bins. NaN is a missing value."""
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


ANGLE_IN = 2.3
STRIP_IN = 0.85
SPEED_IN = 2.0
"""Height of a panel of angles with its title, of the strip of a difference, and of a speed."""

KMH_PER_MPS = 3.6
REACHES_DEG = (0.2, 0.4, 0.6, 1.0, 2.0, 4.0, 6.0, 10.0, 20.0, 40.0, 90.0, 180.0, 360.0)
"""Half-heights of strips."""

COMPARABLE = 3
"""Largest ratio of half-heights at which all blocks have the larger one."""

SHADES = {"unstable": ("unstable", "unstable"), "gps_outage": ("no GPS", "outage")}
"""Label and colour of marked sections."""


class Line(NamedTuple):
    """One estimator in a figure."""

    estimator: str
    label: str
    colour: str


@dataclass(frozen=True)
class DriveBlock:
    """One drive in a figure.

    Attributes
    ----------
    title
        Property in which the drive differs from others.
    run
        The drive with its estimates.
    lines
        Estimators drawn with the true angle; each also has a strip with its difference.
    strips
        Estimators of which the difference alone is drawn.
    shaded
        Name of the section to mark.
    """

    title: str
    run: EvaluatedDrive[TestDrive]
    lines: tuple[Line, ...]
    strips: tuple[Line, ...] = ()
    shaded: str | None = None

    @property
    def all_strips(self) -> tuple[Line, ...]:
        """All estimators of which the difference is drawn."""
        return (*self.lines, *self.strips)

    @property
    def heights_in(self) -> list[float]:
        """Height of its panels."""
        return [ANGLE_IN, *[STRIP_IN] * len(self.all_strips)]

    @property
    def section(self) -> Section | None:
        """The section to mark, if the drive has it."""
        sections = {section.name: section for section in self.run.drive.sections}
        return sections.get(self.shaded or "")

    @property
    def truth_deg(self) -> FloatArray:
        """The true angle, shape (ticks,)."""
        return np.degrees(self.run.drive.sideslip_rad)

    def estimate_deg(self, line: Line) -> FloatArray:
        """Return an estimate, shape (ticks,); NaN where the drive is not evaluated."""
        estimate = np.degrees(self.run.estimates[line.estimator])
        return np.where(self.run.rows, estimate, np.nan)


def side_slip(blocks: Sequence[DriveBlock]) -> Figure:
    """Draw the blocks one above another: the angles, and beneath them the differences."""
    heights_in = [sum(block.heights_in) for block in blocks]
    figure = Figure(figsize=(WIDTH_IN, sum(heights_in)), layout="constrained")
    parts = figure.subfigures(len(blocks), height_ratios=heights_in, squeeze=False)[:, 0]
    for part, block, reach_deg in zip(parts, blocks, _reaches(blocks), strict=True):
        _draw_block(part, block, reach_deg)
    return figure


def _draw_block(figure: FigureBase, block: DriveBlock, reach_deg: float) -> None:
    ratios = {"height_ratios": block.heights_in}
    panels = figure.subplots(len(block.heights_in), sharex=True, gridspec_kw=ratios)
    angle, *strips = panels
    time_s, section = block.run.drive.time_s, block.section
    angle.set_xlim(time_s[0], time_s[-1])
    angle.set_ylabel("side-slip angle (deg)")
    angle.set_title(f"{block.title}\n", fontweight="bold")
    lines = [_plot(angle, time_s, block.estimate_deg(line), line) for line in block.lines]
    lines.insert(0, _plot(angle, time_s, block.truth_deg, Line("", "true", "truth")))
    if section:
        label, tone = SHADES[section.name]
        for stretch in find_stretches(block.run.drive, section.rows):
            for axes in panels:
                axes.axvspan(
                    stretch.from_s, stretch.until_s, color=colour(tone), alpha=0.16, linewidth=0
                )
        lines.append(Patch(color=colour(tone), label=label))
    angle.legend(
        handles=lines,
        ncols=len(lines),
        loc="lower left",
        bbox_to_anchor=(0, 1),
        borderaxespad=0,
        frameon=False,
    )
    for axes, line in zip(strips, block.all_strips, strict=True):
        _plot(axes, time_s, block.estimate_deg(line) - block.truth_deg, line)
        axes.set_ylim(-reach_deg, reach_deg)
        axes.set_yticks([-reach_deg / 2, 0, reach_deg / 2])
        axes.set_title(_errors(block, line), color=colour(line.colour), pad=1)
    for axes in panels[:-1]:
        axes.tick_params(bottom=False)
        axes.spines["bottom"].set_visible(False)
    panels[-1].set_xlabel("time (s)")


def _plot(axes: Axes, x: FloatArray, y: FloatArray, line: Line) -> Artist:
    """Plot the mean of a series, and its range as an area; return the artist for a legend."""
    series, tone = band(x, y, BINS), colour(line.colour)
    if line.estimator:
        axes.fill_between(series.x, series.low, series.high, color=tone, alpha=0.3, linewidth=0)
    return axes.plot(series.x, series.mean, color=tone, linewidth=1.0, label=line.label)[0]


def _reaches(blocks: Sequence[DriveBlock]) -> list[float]:
    """Return the half-height of each block's strips: the same for all if it is readable."""
    reaches = []
    for block in blocks:
        sizes = [np.abs(block.estimate_deg(line) - block.truth_deg) for line in block.all_strips]
        largest = max(float(np.nanmax(values)) for values in sizes)
        reaches.append(next(reach for reach in REACHES_DEG if largest < reach))
    comparable = max(reaches) <= COMPARABLE * min(reaches)
    return [max(reaches)] * len(reaches) if comparable else reaches


def _errors(block: DriveBlock, line: Line) -> str:
    """Return the errors of an estimator in words."""
    errors = block.run.statistics[line.estimator]
    std, mean = degrees(errors.error_std_deg), degrees(errors.error_mean_deg, sign=True)
    return f"{line.label} \N{MINUS SIGN} true: std {std}, mean {mean}"


def speed(drive: TestDrive) -> Figure:
    """Draw the true speed of a drive."""
    figure = Figure(figsize=(WIDTH_IN, SPEED_IN), layout="constrained")
    axes, kmh = figure.subplots(), drive.speed_mps * KMH_PER_MPS
    series = band(drive.time_s, kmh, BINS)
    axes.plot(series.x, series.mean, color=colour("model_4"), linewidth=1.3)
    axes.set_xlim(drive.time_s[0], drive.time_s[-1])
    axes.set_ylim(0, 1.05 * float(kmh.max()))
    axes.set_xlabel("time (s)")
    axes.set_title("speed (km/h)", color=colour("muted"))
    return figure


FILTER_LABELS = {"kalman": "Kalman filter", "kalman_tuned": "Kalman filter, tuned"}


class PaperFigure(NamedTuple):
    """A figure of the paper: its key and title, and the title of each drive in it by scenario.

    `models` of Table I are drawn, by default the paper's choice; the section `shaded` is marked.
    """

    key: str
    title: str
    drives: dict[str, str]
    models: tuple[str, ...] = ()
    shaded: str | None = None


TEST_DRIVE = "side-slip angle on the test drive"
FIGURES = (
    PaperFigure("figure-1a", f"Figure 1(a). {{}}: {TEST_DRIVE}", {"nominal": ""}, ("1", "2")),
    PaperFigure("figure-1b", f"Figure 1(b). {{}}: {TEST_DRIVE}", {"nominal": ""}, ("3", "4", "5")),
    PaperFigure("figure-2", "Figure 2. Speed during the test drive", {"nominal": ""}),
    PaperFigure(
        "figure-3",
        "Figure 3. Effect of increased noise",
        {"nominal": "Initial noise", "noise_doubled": "Bias and noise doubled"},
    ),
    PaperFigure(
        "figure-4",
        "Figure 4. Effect of the car's mass",
        {"mass_1000": "Sprung mass 1000 kg", "mass_1740": "Sprung mass 1740 kg"},
    ),
    PaperFigure(
        "figure-5",
        "Figure 5. Effect of the adhesion coefficient",
        {"adhesion_0_7": "Adhesion 0.7", "adhesion_0_4": "Adhesion 0.4"},
        shaded="unstable",
    ),
    PaperFigure("figure-6", "Figure 6. Speed on the Melbourne circuit", {"melbourne": ""}),
    PaperFigure(
        "figure-7",
        "Figure 7. Side-slip angle on the Melbourne circuit",
        {"melbourne": "Melbourne Grand Prix Circuit"},
    ),
)
SPEEDS = ("figure-2", "figure-6")
OUTAGES = {"nominal": "Nominal drive", "gps_tunnel": "A tunnel of 20 s"}
DRAWN_SCENARIOS = frozenset(OUTAGES).union(*(figure.drives for figure in FIGURES))


def draw_pictures(data: ReportData) -> Iterator[Picture]:
    """Yield the figures whose drives were evaluated and whose models were trained."""
    choice, runs = model_line(data, data.choice_number), data.runs
    for figure in FIGURES:
        if not all(name in runs for name in figure.drives):
            continue
        if figure.key in SPEEDS:
            yield _speed(figure, *(runs[name].drive for name in figure.drives))
            continue
        lines: tuple[Line, ...] = (choice,)
        title, titles = figure.title, figure.drives
        if figure.models:
            lines = tuple(model_line(data, n) for n in figure.models if n in data.evaluated.models)
            names = join_words([line.label for line in lines])
            title, titles = title.format(names), {"nominal": f"Nominal drive, {names}"}
        if lines:
            yield _series(
                figure.key,
                title,
                [DriveBlock(t, runs[name], lines, (), figure.shaded) for name, t in titles.items()],
            )
    filters = [name for name in DRAWN_FILTERS if name in data.evaluated.estimators]
    if filters and "nominal" in runs:
        first, *further = (Line(name, FILTER_LABELS[name], name) for name in filters)
        blocks = [
            DriveBlock(title, runs[name], (first, choice), tuple(further), "gps_outage")
            for name, title in OUTAGES.items()
            if name in runs
        ]
        yield _series("figure-8", "Figure 8. The Kalman filter and the regression", blocks)


def model_line(data: ReportData, model: str) -> Line:
    """Return the line of a model of Table I."""
    return Line(data.evaluated.models[model], f"Model {model}", f"model_{model}")


def _series(key: str, title: str, blocks: Sequence[DriveBlock]) -> Picture:
    caption = " ".join(text for block in blocks for text in _results(block, len(blocks) > 1))
    description = (
        "Lines over time of the true angle and of the estimates, and beneath them the differences."
    )
    return Picture(key, title, caption, description, lambda: side_slip(blocks))


def _results(block: DriveBlock, named: bool) -> Iterator[str]:
    """Yield the sentences of a caption about the errors in a block."""
    errors = "; ".join(_errors(block, line) for line in block.all_strips)
    yield f"{block.title}: {errors}." if named else f"{errors}."
    if block.shaded != "unstable":
        return
    if block.section is None:
        yield "The car is stable throughout."
        return
    estimator, rows = block.lines[0].estimator, block.section.rows
    inside, outside = (block.run.within(r).statistics[estimator] for r in (rows, ~rows))
    yield (
        f"Where the car is unstable (shaded) std is {degrees(inside.error_std_deg)}, elsewhere "
        f"{degrees(outside.error_std_deg)} with a correlation of {number(outside.correlation)}."
    )


def _speed(figure: PaperFigure, drive: TestDrive) -> Picture:
    kmh = drive.speed_mps * KMH_PER_MPS
    caption = (
        f"From {kmh.min():.0f} to {kmh.max():.0f} km/h in {drive.time_s[-1]:.0f} s, over "
        f"{drive.scenario.track.length_m / 1000:.2f} km."
    )
    description = "A line of speed over time."
    return Picture(figure.key, figure.title, caption, description, lambda: speed(drive))
