"""The figures of the paper, in its order, with captions from the same data."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.evaluation.charts import (
    KMH_PER_MPS,
    DriveBlock,
    Line,
    Map,
    Named,
    Series,
    angle_and_gates,
    car_by_car,
    error_by_acceleration,
    error_map,
    error_over,
    opening,
    points_by_drive,
    side_slip,
    speed,
)
from fleet_slip.evaluation.evaluate import LEAST_COVERAGE
from fleet_slip.evaluation.report_data import DRAWN_FILTERS, TRAINED_SHARE, ReportData
from fleet_slip.evaluation.report_tables import TEXTS, compared, read_toml, won
from fleet_slip.pages.drawing import Picture, Size
from fleet_slip.pages.page import degrees, listed, number

FILTER_LABELS = {"kalman": "Kalman filter", "kalman_tuned": "Kalman filter, tuned"}


class Drives(NamedTuple):
    """A figure of the paper: the speed in one drive, or angles in some drives.

    Attributes:
        key, title: as of a `Picture`.
        drives: title by scenario; the figure needs them all.
        models: those of Table I that are drawn; none for the one that the paper settles on.
        shaded: name of the section to mark.
    """

    key: str
    title: str
    drives: dict[str, str]
    models: tuple[str, ...] = ()
    shaded: str | None = None


TEST_DRIVE = "side-slip angle on the test drive"
FIGURES = (
    Drives("figure-1a", f"Figure 1(a). {{}}: {TEST_DRIVE}", {"nominal": ""}, ("1", "2")),
    Drives("figure-1b", f"Figure 1(b). {{}}: {TEST_DRIVE}", {"nominal": ""}, ("3", "4", "5")),
    Drives("figure-2", "Figure 2. Speed during the test drive", {"nominal": ""}),
    Drives(
        "figure-3",
        "Figure 3. Effect of increased noise",
        {"nominal": "Initial noise", "noise_doubled": "Bias and noise doubled"},
    ),
    Drives(
        "figure-4",
        "Figure 4. Effect of the car's mass",
        {"mass_1000": "Sprung mass 1000 kg", "mass_1740": "Sprung mass 1740 kg"},
    ),
    Drives(
        "figure-5",
        "Figure 5. Effect of the adhesion coefficient",
        {"adhesion_0_7": "Adhesion 0.7", "adhesion_0_4": "Adhesion 0.4"},
        shaded="unstable",
    ),
    Drives("figure-6", "Figure 6. Speed on the Melbourne circuit", {"melbourne": ""}),
    Drives(
        "figure-7",
        "Figure 7. Side-slip angle on the Melbourne circuit",
        {"melbourne": "Melbourne Grand Prix Circuit"},
    ),
)
SPEEDS = ("figure-2", "figure-6")


def paper_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the figures whose drives were evaluated, and whose models could be trained."""
    for one in FIGURES:
        if not all(name in data.runs for name in one.drives):
            continue
        if one.key in SPEEDS:
            yield _speed(data, one)
        elif not one.models:
            yield _series(one.key, one.title, _blocks(data, one, (choice_line(data),)))
        elif lines := tuple(model_line(data, n) for n in one.models if n in data.evaluated.models):
            names = listed([line.label for line in lines])
            blocks = _blocks(
                data, one._replace(drives={"nominal": f"Nominal drive, {names}"}), lines
            )
            yield _series(one.key, one.title.format(names), blocks)
    yield from _against_the_filter(data)


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


def _blocks(data: ReportData, one: Drives, lines: tuple[Line, ...]) -> list[DriveBlock]:
    return [
        DriveBlock(title, data.runs[name], lines, shaded=one.shaded)
        for name, title in one.drives.items()
    ]


def _against_the_filter(data: ReportData) -> Iterator[Picture]:
    filters = [
        Line(name, FILTER_LABELS[name], name)
        for name in DRAWN_FILTERS
        if name in data.evaluated.estimators
    ]
    if filters and "nominal" in data.runs:
        drives = {"nominal": "Nominal drive", "gps_tunnel": "A tunnel of 20 s"}
        lines, strips = (filters[0], choice_line(data)), tuple(filters[1:])
        blocks = [
            DriveBlock(title, data.runs[name], lines, strips, shaded="gps_outage")
            for name, title in drives.items()
            if name in data.runs
        ]
        yield _series("figure-8", "Figure 8. The Kalman filter and the regression", blocks)


def _series(key: str, title: str, blocks: Sequence[DriveBlock]) -> Picture:
    found = " ".join(sentence for block in blocks for sentence in _found(block, len(blocks) > 1))
    seen = (
        "Lines over time of the true angle and of the estimates, and beneath them the differences."
    )
    return Picture(key, title, found, seen, lambda size: side_slip(blocks, size))


def _found(block: DriveBlock, named: bool) -> Iterator[str]:
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
        yield _stability(block)


def _stability(block: DriveBlock) -> str:
    result = block.run.results[block.lines[0].estimator]
    if "unstable" not in result.inside:
        return "The car is stable throughout."
    inside, outside = result.inside["unstable"], result.outside["unstable"]
    return (
        f"Where the car is unstable (shaded) it is {degrees(inside.error_std_deg)}, elsewhere "
        f"{degrees(outside.error_std_deg)} with a correlation of {number(outside.correlation)}."
    )


def _speed(data: ReportData, one: Drives) -> Picture:
    (drive,) = (data.runs[name].drive for name in one.drives)
    kmh = drive.speed_mps * KMH_PER_MPS
    caption = (
        f"From {kmh.min():.0f} to {kmh.max():.0f} km/h in {drive.time_s[-1]:.0f} s, over "
        f"{drive.scenario.track.length_m / 1000:.2f} km."
    )
    seen = "A line of speed over time."
    return Picture(one.key, one.title, caption, seen, lambda size: speed(drive, size))


# Figures beyond the paper: where and when estimates are off, a fleet's cars.

SLIPPERY = "adhesion_0_4"
STYLES = ("style_gentle", "nominal", "style_brisk", "style_sporty", "style_limit")
"""Drives of the training car on a dry road, from slow to the limit."""

PICTURES = read_toml("pictures.toml")


def draw_pictures(data: ReportData) -> tuple[Picture, ...]:
    """Return all figures whose drives were evaluated, with captions from the same data."""
    parts = (paper_pictures, further_pictures, road_pictures, fleet_pictures)
    return tuple(picture for part in parts for picture in part(data))


def _picture(key: str, drawn: Callable[[Size], Figure], **words: Any) -> Picture:
    """Return a figure of `pictures.toml`, whose texts have these words."""
    title, caption, seen = (
        TEXTS.from_string(PICTURES[key][part]).render(words)
        for part in ("title", "caption", "seen")
    )
    return Picture(key, title, caption, seen, drawn)


def further_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the figures that belong to no other section."""
    choice = choice_line(data).label
    maps = {"nominal": "Nominal drive", SLIPPERY: "Adhesion 0.4"}
    shown = [
        Map(title, data.runs[name], data.choice)
        for name, title in maps.items()
        if name in data.runs
    ]
    if shown:
        titles = [one.title for one in shown]
        yield _picture(
            "error-map", lambda size: error_map(shown, size), choice=choice, titles=titles
        )
    if "style_limit" in data.runs:
        yield _lateral(data)
    yield _standings(data)
    if data.evaluated.gps_noise is not None:
        yield _over_gps_noise(data, data.evaluated.gps_noise)


def _lateral(data: ReportData) -> Picture:
    driven = [data.runs[name] for name in STYLES if name in data.runs]
    lines = [model_line(data, n) for n in ("1", "2", "4") if n in data.evaluated.models]
    published = data.version.reference
    further = (
        Line(published, published, "model_3"),
        Line("kalman_tuned", "Kalman, tuned", "kalman_tuned"),
    )
    lines += [line for line in further if line.estimator in data.evaluated.estimators]
    trained_to = data.trained_to_mps2
    return _picture(
        "lateral-acceleration",
        lambda size: error_by_acceleration(driven, lines, trained_to, size),
        share=TRAINED_SHARE,
        trained_to=trained_to,
    )


def _standings(data: ReportData) -> Picture:
    """Return every estimator on every test drive as points."""
    evaluated, shown = data.evaluated, compared(data)
    choices = [
        Named(data.version.reference, data.version.reference, "model_3"),
        Named(data.choice, f"Model {data.choice_number}", "model_4"),
        Named("ekf_class_tuned", "EKF told the class, tuned", "kalman"),
        Named("ekf_told_tuned", "EKF told everything, tuned", "model_2"),
    ]
    errors = {
        scenario: {
            name: one.rmse_deg
            for name in shown
            if (one := evaluated.figures(scenario, name))
            and one.rmse_deg
            and one.coverage >= LEAST_COVERAGE
        }
        for scenario in evaluated.scenarios
    }
    return _picture(
        "test-drives",
        lambda size: points_by_drive(errors, [n for n in choices if n.estimator in shown], size),
        won=won(data),
        least_coverage=LEAST_COVERAGE,
    )


def _over_gps_noise(data: ReportData, sweep: Mapping[str, Any]) -> Picture:
    levels, choice = sweep["levels"], choice_line(data).label
    noise = np.array([level["velocity_std_mps"] for level in levels])
    lines = [
        Series(FILTER_LABELS[name], name, np.array([level["rmse_deg"][name] for level in levels]))
        for name in DRAWN_FILTERS
        if name in levels[0]["rmse_deg"]
    ]
    for label, colour, name in (
        (choice, "model_4", data.choice),
        (data.version.reference, "model_3", data.version.reference),
    ):
        if name in sweep["regressions"]:
            lines.append(Series(label, colour, np.full(len(noise), sweep["regressions"][name])))
    return _picture(
        "gps-noise",
        lambda size: error_over(noise, "noise of GPS velocity (m/s)", lines, size),
        choice=choice,
        equal=sweep["equal_at_mps"].get("kalman_tuned", {}).get(data.choice),
    )


def road_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the slippery drive with the gates of the published model; none without gates."""
    if SLIPPERY not in data.runs:
        return
    run, reference = data.runs[SLIPPERY], data.version.reference
    gates, line = opening(data.version.manifest, run), Line(reference, reference, "model_3")
    if gates:
        yield _picture(
            "road-gates",
            lambda size: angle_and_gates(run, line, gates, size),
            reference=reference,
            ours=run.results[reference].whole,
            one_instant=run.results[data.choice].whole,
        )


def fleet_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the fleet car by car before and after calibration; none without a fleet."""
    if (cars := data.cars) is not None:
        yield _picture("fleet-cars", lambda size: car_by_car(cars, size), cars=cars)
