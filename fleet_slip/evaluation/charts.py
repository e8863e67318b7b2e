"""The paper's figures, in its order: angles and speed over time, captions from the same data."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Patch

from fleet_slip.arrays import FloatArray
from fleet_slip.evaluation.evaluated_drives import TestDrive, find_stretches
from fleet_slip.evaluation.evaluation_document import DRAWN_FILTERS, ReportData
from fleet_slip.evaluation.evaluator import EvaluatedDrive
from fleet_slip.pages.page import BINS, WIDTH_IN, Picture, colour, degrees, join_words

ANGLE_IN = 2.3
STRIP_IN = 0.85
SPEED_IN = 2.0
"""Height of a panel of angles with its title, of the strip of a difference, and of a speed."""

KMH_PER_MPS = 3.6


class PaperFigure(NamedTuple):
    """A figure of the paper, its title, and that of each drive in it by scenario.

    It shows speeds, or the angles of the models of Table I or estimators named in `estimators`,
    where `CHOICE` is the model that the paper chooses.
    """

    number: str
    title: str
    drives: Mapping[str, str]
    estimators: tuple[str, ...] = ()


CHOICE = "choice"
NOMINAL = {"nominal": ""}
TEST_DRIVE = "side-slip angle on the test drive"
NOISE = {"nominal": "Initial noise", "noise_doubled": "Bias and noise doubled"}
MASS = {"mass_1000": "Sprung mass 1000 kg", "mass_1740": "Sprung mass 1740 kg"}
ADHESION = {"adhesion_0_7": "Adhesion 0.7", "adhesion_0_4": "Adhesion 0.4"}
CIRCUIT = {"melbourne": "Melbourne Grand Prix Circuit"}
FILTERED = (*DRAWN_FILTERS, CHOICE)
FIGURES = (
    PaperFigure("1a", f"1(a). Models 1 and 2: {TEST_DRIVE}", NOMINAL, ("1", "2")),
    PaperFigure("1b", f"1(b). Models 3 to 5: {TEST_DRIVE}", NOMINAL, ("3", "4", "5")),
    PaperFigure("2", "2. Speed during the test drive", NOMINAL),
    PaperFigure("3", "3. Effect of increased noise", NOISE, (CHOICE,)),
    PaperFigure("4", "4. Effect of the car's mass", MASS, (CHOICE,)),
    PaperFigure("5", "5. Effect of the adhesion coefficient", ADHESION, (CHOICE,)),
    PaperFigure("6", "6. Speed on the Melbourne circuit", CIRCUIT),
    PaperFigure("7", "7. Side-slip angle on the Melbourne circuit", CIRCUIT, (CHOICE,)),
    PaperFigure(
        "8", "8. The Kalman filter and the regression", {"nominal": "Nominal drive"}, FILTERED
    ),
)
DRAWN_SCENARIOS = frozenset[str]().union(*(figure.drives for figure in FIGURES))


class Line(NamedTuple):
    """One estimator in a figure; without a name it is the true angle."""

    estimator: str
    label: str
    colour: str


class DriveBlock(NamedTuple):
    """One drive in a figure: the true angle and estimates, and a strip for each difference."""

    title: str
    run: EvaluatedDrive[TestDrive]
    lines: Sequence[Line]

    @property
    def heights_in(self) -> list[float]:
        """Height of its panels."""
        return [ANGLE_IN, *[STRIP_IN] * len(self.lines)]

    def errors(self, line: Line) -> str:
        """Return the errors of an estimator in words."""
        errors = self.run.statistics[line.estimator]
        std, mean = degrees(errors.error_std_deg), degrees(errors.error_mean_deg, sign=True)
        return f"{line.label} \N{MINUS SIGN} true: std {std}, mean {mean}"


def draw_pictures(data: ReportData) -> Iterator[Picture]:
    """Yield the figures whose drives were evaluated and whose models were trained."""
    for figure in FIGURES:
        runs = [data.runs[name] for name in figure.drives if name in data.runs]
        lines = list(_lines(data, figure.estimators))
        if len(runs) < len(figure.drives) or (figure.estimators and not lines):
            continue
        if figure.estimators:
            blocks = [
                DriveBlock(title or join_words([line.label for line in lines]), run, lines)
                for title, run in zip(figure.drives.values(), runs, strict=True)
            ]
            caption = " ".join(
                f"{block.title}: {'; '.join(map(block.errors, lines))}." for block in blocks
            )
            description = (
                "Lines over time of the true angle and of the estimates, and beneath them the "
                "differences."
            )
            drawn = partial(side_slip, blocks)
        else:
            drive = runs[0].drive
            kmh = drive.speed_mps * KMH_PER_MPS
            caption = (
                f"From {kmh.min():.0f} to {kmh.max():.0f} km/h in {drive.time_s[-1]:.0f} s, over "
                f"{drive.scenario.track.length_m / 1000:.2f} km."
            )
            description, drawn = "A line of speed over time.", partial(speed, drive.time_s, kmh)
        key, title = f"figure-{figure.number}", f"Figure {figure.title}"
        yield Picture(key, title, caption, description, drawn)


def _lines(data: ReportData, names: Sequence[str]) -> Iterator[Line]:
    """Yield the estimators of a figure that the evaluation has."""
    for name in names:
        model = data.choice_number if name == CHOICE else name
        if model in data.models:
            yield Line(data.models[model], f"Model {model}", f"model_{model}")
        elif name in data.estimators:
            label = "Kalman filter" + (", tuned" if name.endswith("tuned") else "")
            yield Line(name, label, name)


def side_slip(blocks: Sequence[DriveBlock]) -> Figure:
    """Draw the blocks one above another: the angles, and beneath them the differences."""
    heights_in = [sum(block.heights_in) for block in blocks]
    figure = Figure(figsize=(WIDTH_IN, sum(heights_in)), layout="constrained")
    parts = figure.subfigures(len(blocks), height_ratios=heights_in, squeeze=False)[:, 0]
    for part, block in zip(parts, blocks, strict=True):
        _draw_block(part, block)
    return figure


def _draw_block(figure: FigureBase, block: DriveBlock) -> None:
    ratios = {"height_ratios": block.heights_in}
    panels = figure.subplots(len(block.heights_in), sharex=True, gridspec_kw=ratios)
    angle, *strips = panels
    drive = block.run.drive
    truth_deg = np.degrees(drive.sideslip_rad)
    angle.set_xlim(drive.time_s[0], drive.time_s[-1])
    angle.set_ylabel("side-slip angle (deg)")
    angle.set_title(f"{block.title}\n", fontweight="bold")
    estimates_deg = [
        np.where(block.run.rows, np.degrees(block.run.estimates[line.estimator]), np.nan)
        for line in block.lines
    ]
    artists = [
        _plot(angle, drive.time_s, estimate_deg, line)
        for estimate_deg, line in zip(estimates_deg, block.lines, strict=True)
    ]
    artists.insert(0, _plot(angle, drive.time_s, truth_deg, Line("", "true", "truth")))
    if "unstable" in drive.sections:
        for stretch in find_stretches(drive, drive.sections["unstable"]):
            for axes in panels:
                shade = {"color": colour("unstable"), "alpha": 0.16, "linewidth": 0}
                axes.axvspan(stretch["from_s"], stretch["until_s"], **shade)
        artists.append(Patch(color=colour("unstable"), label="unstable"))
    angle.legend(
        handles=artists,
        ncols=len(artists),
        loc="lower left",
        bbox_to_anchor=(0, 1),
        borderaxespad=0,
        frameon=False,
    )
    for axes, line, estimate_deg in zip(strips, block.lines, estimates_deg, strict=True):
        _plot(axes, drive.time_s, estimate_deg - truth_deg, line)
        axes.locator_params(axis="y", nbins=3, symmetric=True)
        axes.set_title(block.errors(line), color=colour(line.colour), pad=1)
    reach_deg = max(abs(limit) for axes in strips for limit in axes.get_ylim())
    for axes in strips:
        axes.set_ylim(-reach_deg, reach_deg)
    for axes in panels[:-1]:
        axes.tick_params(bottom=False)
        axes.spines["bottom"].set_visible(False)
    panels[-1].set_xlabel("time (s)")


def _plot(axes: Axes, x: FloatArray, y: FloatArray, line: Line) -> Artist:
    """Plot the mean of a series, and its range as an area; return the artist for a legend."""
    series, tone = band(x, y, BINS), colour(line.colour)
    if line.estimator:
        low, high = series["low"], series["high"]
        axes.fill_between(series["x"], low, high, color=tone, alpha=0.3, linewidth=0)
    return axes.plot(series["x"], series["mean"], color=tone, linewidth=1.0, label=line.label)[0]


def band(x: FloatArray, y: FloatArray, bins: int) -> dict[str, FloatArray]:
    """Cut a series into at most `bins` equal bins: middle `x`, `mean`, `low` and `high` of each.

    NaN is a missing value.
    """
    part = pl.int_range(pl.len()) // -(-len(x) // bins)
    y_column = pl.col("y").fill_nan(None)
    series = (
        pl.DataFrame({"x": x, "y": y})
        .group_by(part, maintain_order=True)
        .agg(pl.mean("x"), mean=y_column.mean(), low=y_column.min(), high=y_column.max())
    )
    return {name: series[name].to_numpy() for name in ("x", "mean", "low", "high")}


def speed(time_s: FloatArray, kmh: FloatArray) -> Figure:
    """Draw the true speed of a drive."""
    figure = Figure(figsize=(WIDTH_IN, SPEED_IN), layout="constrained")
    axes, series = figure.subplots(), band(time_s, kmh, BINS)
    axes.plot(series["x"], series["mean"], color=colour("model_4"), linewidth=1.3)
    axes.set_xlim(time_s[0], time_s[-1])
    axes.set_ylim(0, 1.05 * float(kmh.max()))
    axes.set_xlabel("time (s)")
    axes.set_title("speed (km/h)", color=colour("muted"))
    return figure
