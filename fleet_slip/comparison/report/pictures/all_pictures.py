"""Which figures a report has, in the order of the paper, with captions from the same data."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from fleet_slip.comparison.evaluation.runs import EvaluatedScenario
from fleet_slip.comparison.report.figures.columns import Series, error_over
from fleet_slip.comparison.report.figures.density import density
from fleet_slip.comparison.report.figures.lateral import error_by_acceleration
from fleet_slip.comparison.report.figures.series import Block, Line, side_slip
from fleet_slip.comparison.report.figures.speed import KMH_PER_MPS, speed
from fleet_slip.comparison.report.figures.track_map import Map, error_map
from fleet_slip.comparison.report.findings.histogram import Histogram
from fleet_slip.comparison.report.findings.report_data import DRAWN_FILTERS, ReportData
from fleet_slip.comparison.report.pictures.fleet_pictures import fleet_pictures
from fleet_slip.comparison.report.pictures.memory_pictures import memory_pictures
from fleet_slip.comparison.report.pictures.road_pictures import road_pictures, standings_picture
from fleet_slip.pages.picture import Picture
from fleet_slip.pages.text import count, degrees, listed, number, percent

STYLES = ("style_gentle", "nominal", "style_brisk", "style_sporty", "style_limit")
"""Drives of the training car on a dry road, from slow to the limit."""

TRAINED_SHARE = 0.999

FILTER_LABELS = {"kalman": "Kalman filter", "kalman_tuned": "Kalman filter, tuned"}


def draw_pictures(data: ReportData) -> tuple[Picture, ...]:
    """Return all figures whose drives were evaluated."""
    return (
        *_of_the_paper(data),
        *_beyond_the_paper(data),
        *memory_pictures(data),
        *road_pictures(data),
        *fleet_pictures(data.cars),
    )


def model_line(data: ReportData, number_in_table: str) -> Line:
    """Return how a model of Table I is drawn."""
    return Line(
        data.evaluated.models[number_in_table],
        f"Model {number_in_table}",
        f"model_{number_in_table}",
    )


def choice_line(data: ReportData) -> Line:
    """Return how the model that the paper settles on is drawn."""
    return model_line(data, data.choice_number)


def _has(data: ReportData, *scenarios: str) -> bool:
    return all(name in data.runs for name in scenarios)


def _of_the_paper(data: ReportData) -> Iterator[Picture]:
    if _has(data, "nominal"):
        nominal = data.runs["nominal"]
        for part, numbers in (("a", ("1", "2")), ("b", ("3", "4", "5"))):
            lines = tuple(model_line(data, n) for n in numbers if n in data.evaluated.models)
            if not lines:  # the training drives have no signals for any of these
                continue
            yield _series(
                f"figure-1{part}",
                f"Figure 1({part}). {listed([line.label for line in lines])}: side-slip angle on "
                "the test drive",
                [Block(f"Nominal drive, {listed([line.label for line in lines])}", nominal, lines)],
            )
        yield _speed("figure-2", "Figure 2. Speed during the test drive", nominal)
    applied = (choice_line(data),)
    if _has(data, "nominal", "noise_doubled"):
        yield _series(
            "figure-3",
            "Figure 3. Effect of increased noise",
            [
                Block("Initial noise", data.runs["nominal"], applied),
                Block("Bias and noise doubled", data.runs["noise_doubled"], applied),
            ],
        )
    if _has(data, "mass_1000", "mass_1740"):
        yield _series(
            "figure-4",
            "Figure 4. Effect of the car's mass",
            [
                Block("Sprung mass 1000 kg", data.runs["mass_1000"], applied),
                Block("Sprung mass 1740 kg", data.runs["mass_1740"], applied),
            ],
        )
    if _has(data, "adhesion_0_7", "adhesion_0_4"):
        yield _series(
            "figure-5",
            "Figure 5. Effect of the adhesion coefficient",
            [
                Block("Adhesion 0.7", data.runs["adhesion_0_7"], applied, shaded="unstable"),
                Block("Adhesion 0.4", data.runs["adhesion_0_4"], applied, shaded="unstable"),
            ],
        )
    if _has(data, "melbourne"):
        melbourne = data.runs["melbourne"]
        yield _speed("figure-6", "Figure 6. Speed on the Melbourne circuit", melbourne)
        yield _series(
            "figure-7",
            "Figure 7. Side-slip angle on the Melbourne circuit",
            [Block("Melbourne Grand Prix Circuit", melbourne, applied)],
        )
    yield from _against_the_filter(data, applied)


def _against_the_filter(data: ReportData, applied: tuple[Line, ...]) -> Iterator[Picture]:
    known = [name for name in DRAWN_FILTERS if name in data.evaluated.estimators]
    if known and _has(data, "nominal"):
        filters = tuple(Line(name, FILTER_LABELS[name], name) for name in known)
        drives = [("Nominal drive", "nominal"), ("A tunnel of 20 s", "gps_tunnel")]
        yield _series(
            "figure-8",
            "Figure 8. The Kalman filter and the regression",
            [
                Block(
                    title,
                    data.runs[name],
                    (filters[0], *applied),
                    strips=filters[1:],
                    shaded="gps_outage",
                )
                for title, name in drives
                if name in data.runs
            ],
        )


def _series(key: str, title: str, blocks: Sequence[Block]) -> Picture:
    found = [sentence for block in blocks for sentence in _found(block, len(blocks) > 1)]
    return Picture(
        key=key,
        title=title,
        caption=" ".join(found),
        alternative=(
            f"{title}. Lines over time of the true angle and of the estimates, and beneath them "
            f"the differences. {' '.join(found)}"
        ),
        draw=lambda size: side_slip(blocks, size),
    )


def _found(block: Block, named: bool) -> Iterator[str]:
    errors = []
    for line in block.all_strips:
        figures = block.run.results[line.estimator].whole
        errors.append(
            f"{line.label} {degrees(figures.error_std_deg)} "
            f"({degrees(figures.error_mean_deg, sign=True)})"
        )
    place = f"{block.title}: standard" if named else "Standard"
    yield f"{place} deviation (mean) of the error: {', '.join(errors)}."
    if block.shaded == "unstable":
        yield from _stability(block)


def _stability(block: Block) -> Iterator[str]:
    result = block.run.results[block.lines[0].estimator]
    if "unstable" not in result.inside:
        yield "The car is stable throughout."
        return
    inside, outside = result.inside["unstable"], result.outside["unstable"]
    yield (
        f"Where the car is unstable (shaded) it is {degrees(inside.error_std_deg)}, elsewhere "
        f"{degrees(outside.error_std_deg)} with a correlation of {number(outside.correlation)}."
    )


def _speed(key: str, title: str, run: EvaluatedScenario) -> Picture:
    kmh = run.drive.speed_mps * KMH_PER_MPS
    caption = (
        f"From {kmh.min():.0f} to {kmh.max():.0f} km/h in {run.drive.time_s[-1]:.0f} s, over "
        f"{run.drive.scenario.track.length_m / 1000:.2f} km."
    )
    return Picture(
        key, title, caption, f"{title}: a line of speed over time. {caption}",
        lambda size: speed(run.drive, size),
    )  # fmt: skip


def _beyond_the_paper(data: ReportData) -> Iterator[Picture]:
    maps = [("Nominal drive", "nominal"), ("Adhesion 0.4", "adhesion_0_4")]
    shown = [Map(title, data.runs[name], data.choice) for title, name in maps if name in data.runs]
    if shown:
        yield _map(data, shown)
    yield _density(data, data.histogram)
    yield from _lateral(data, data.runs)
    yield standings_picture(data)
    if data.evaluated.gps_noise is not None:
        yield _over_gps_noise(data, data.evaluated.gps_noise)


def _map(data: ReportData, shown: Sequence[Map]) -> Picture:
    label = choice_line(data).label
    title = f"Where on the track {label} is off"
    caption = (
        "Blue: the estimate is too far to the right; orange: too far to the left. The error "
        "follows the bends: what is left is systematic, not noise."
    )
    return Picture(
        "error-map",
        title,
        caption,
        f"{title}: maps of the track for {listed([one.title for one in shown])}, coloured by the "
        "error.",
        lambda size: error_map(shown, size),
    )


def _density(data: ReportData, histogram: Histogram) -> Picture:
    label = choice_line(data).label
    model = next(m for m in data.trained.selection.models if f"Model {m.name}" == label)
    title = "Predicted against true"
    caption = (
        f"All {count(int(histogram.rows.sum()))} rows of the training drives, each predicted by "
        f"the {label} that was fitted without its fold of drives: correlation "
        f"{number(model.correlation, 4)}, error {degrees(model.pooled.error_std_deg)}."
    )
    return Picture(
        "density", title, caption, f"{title}: a density along the diagonal. {caption}",
        lambda size: density(histogram, size),
    )  # fmt: skip


def _lateral(data: ReportData, runs: Mapping[str, EvaluatedScenario]) -> Iterator[Picture]:
    driven = [runs[name] for name in STYLES if name in runs]
    if "style_limit" not in runs:
        return
    wanted = [n for n in ("1", "2", "4") if n in data.evaluated.models]
    lines = [model_line(data, n) for n in wanted]
    published = data.version.reference
    if published in data.evaluated.estimators:
        lines.append(Line(published, published, "model_3"))
    if "kalman_tuned" in data.evaluated.estimators:
        lines.append(Line("kalman_tuned", "Kalman, tuned", "kalman_tuned"))
    trained_to = data.histogram.trained_to_mps2(TRAINED_SHARE)
    title = "Error by lateral acceleration"
    caption = (
        f"Five dry test drives of the training car, from a gentle driver to a racing one. "
        f"{percent(TRAINED_SHARE, 1)} of the training rows lie below {trained_to:.1f} m/s² "
        "(shaded). Beyond, tyres are no longer linear, and a linear model that has not seen it "
        "cannot follow; the Kalman filter, which integrates accelerations, does."
    )
    yield Picture(
        "lateral-acceleration",
        title,
        caption,
        f"{title}: the root mean square error of each estimator in bins of lateral acceleration. "
        f"{caption}",
        lambda size: error_by_acceleration(driven, lines, trained_to, size),
    )


def _over_gps_noise(data: ReportData, sweep: Mapping[str, Any]) -> Picture:
    levels = sweep["levels"]
    noise = np.array([level["velocity_std_mps"] for level in levels])
    lines = [
        Series(FILTER_LABELS[name], name, np.array([level["rmse_deg"][name] for level in levels]))
        for name in DRAWN_FILTERS
        if name in levels[0]["rmse_deg"]
    ]
    for label, colour, name in (
        (choice_line(data).label, "model_4", data.choice),
        (data.version.reference, "model_3", data.version.reference),
    ):
        if name in sweep["regressions"]:
            lines.append(Series(label, colour, np.full(len(noise), sweep["regressions"][name])))
    equal = sweep["equal_at_mps"].get("kalman_tuned", {}).get(data.choice)
    told = (
        f"With the tuned filter {choice_line(data).label} is level at {equal:.3f} m/s. "
        if equal is not None
        else ""
    )
    title = "The Kalman filter over the noise of GPS"
    caption = (
        "The nominal drive without outages; the filter is told how noisy the GPS velocity is. "
        f"{told}The regressions use no GPS."
    )
    return Picture(
        "gps-noise",
        title,
        caption,
        f"{title}: rising lines of the filters, level ones of the regressions. {caption}",
        lambda size: error_over(noise, "noise of GPS velocity (m/s)", lines, size),
    )
