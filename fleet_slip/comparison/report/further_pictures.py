"""Figures beyond the paper: where and when estimates are off, what memory buys, a fleet's cars."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fleet_slip.comparison.evaluation.ranking import LEAST_COVERAGE
from fleet_slip.comparison.report.column_worth import Memory
from fleet_slip.comparison.report.error_charts import (
    Series,
    car_by_car,
    error_by_acceleration,
    error_by_columns,
    error_over,
    left_out,
)
from fleet_slip.comparison.report.gate_strips import angle_and_gates, opening
from fleet_slip.comparison.report.paper_pictures import (
    FILTER_LABELS,
    choice_line,
    model_line,
    paper_pictures,
)
from fleet_slip.comparison.report.point_charts import Named, density, points_by_drive
from fleet_slip.comparison.report.report_data import DRAWN_FILTERS, ReportData
from fleet_slip.comparison.report.report_tables import compared, won
from fleet_slip.comparison.report.time_series import Line
from fleet_slip.comparison.report.track_map import FINE_EDGES_DEG, Map, error_map
from fleet_slip.pages.drawing import Picture
from fleet_slip.pages.page_parts import count, degrees, listed, number, percent

SLIPPERY = "adhesion_0_4"
STYLES = ("style_gentle", "nominal", "style_brisk", "style_sporty", "style_limit")
"""Drives of the training car on a dry road, from slow to the limit."""

TRAINED_SHARE = 0.999


def draw_pictures(data: ReportData) -> tuple[Picture, ...]:
    """Return all figures whose drives were evaluated, with captions from the same data."""
    parts = (paper_pictures, further_pictures, memory_pictures, road_pictures, fleet_pictures)
    return tuple(picture for part in parts for picture in part(data))


def further_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the figures that belong to no other section."""
    maps = {"nominal": "Nominal drive", SLIPPERY: "Adhesion 0.4"}
    shown = [
        Map(title, data.runs[name], data.choice)
        for name, title in maps.items()
        if name in data.runs
    ]
    if shown:
        yield Picture(
            "error-map",
            f"Where on the track {choice_line(data).label} is off",
            "Blue: the estimate is too far to the right; orange: too far to the left. The error "
            "follows the bends: what is left is systematic, not noise.",
            f"Maps of the track for {listed([one.title for one in shown])}, coloured by the error.",
            lambda size: error_map(shown, size),
        )
    yield _density(data)
    if "style_limit" in data.runs:
        yield _lateral(data)
    yield _standings(data)
    if data.evaluated.gps_noise is not None:
        yield _over_gps_noise(data, data.evaluated.gps_noise)


def _density(data: ReportData) -> Picture:
    histogram, label = data.histogram, choice_line(data).label
    model = next(m for m in data.trained.selection.models if f"Model {m.name}" == label)
    return Picture(
        "density",
        "Predicted against true",
        f"All {count(int(histogram.rows.sum()))} rows of the training drives, each predicted by "
        f"the {label} that was fitted without its fold of drives: correlation "
        f"{number(model.correlation, 4)}, error {degrees(model.pooled.error_std_deg)}.",
        "A density along the diagonal.",
        lambda size: density(histogram, size),
    )


def _lateral(data: ReportData) -> Picture:
    driven = [data.runs[name] for name in STYLES if name in data.runs]
    lines = [model_line(data, n) for n in ("1", "2", "4") if n in data.evaluated.models]
    published = data.version.reference
    further = (
        Line(published, published, "model_3"),
        Line("kalman_tuned", "Kalman, tuned", "kalman_tuned"),
    )
    lines += [line for line in further if line.estimator in data.evaluated.estimators]
    trained_to = data.histogram.trained_to_mps2(TRAINED_SHARE)
    return Picture(
        "lateral-acceleration",
        "Error by lateral acceleration",
        f"Five dry test drives of the training car, from a gentle driver to a racing one. "
        f"{percent(TRAINED_SHARE, 1)} of the training rows lie below {trained_to:.1f} m/s² "
        "(shaded). Beyond, tyres are no longer linear, and a linear model that has not seen it "
        "cannot follow; the Kalman filter, which integrates accelerations, does.",
        "The root mean square error of each estimator in bins of lateral acceleration.",
        lambda size: error_by_acceleration(driven, lines, trained_to, size),
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
    return Picture(
        "test-drives",
        "Every estimator on every test drive",
        f"The further to the left, the better. {won(data)}Who has estimates for less than "
        f"{percent(LEAST_COVERAGE)} of a drive is not drawn there.",
        "A row for each test drive, a point for the error of each estimator.",
        lambda size: points_by_drive(errors, [n for n in choices if n.estimator in shown], size),
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
    equal = sweep["equal_at_mps"].get("kalman_tuned", {}).get(data.choice)
    told = "" if equal is None else f"With the tuned filter {choice} is level at {equal:.3f} m/s. "
    return Picture(
        "gps-noise",
        "The Kalman filter over the noise of GPS",
        "The nominal drive without outages; the filter is told how noisy the GPS velocity is. "
        f"{told}The regressions use no GPS.",
        "Rising lines of the filters, level ones of the regressions.",
        lambda size: error_over(noise, "noise of GPS velocity (m/s)", lines, size),
    )


def road_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the slippery drive with the gates of the published model; none without gates."""
    if SLIPPERY not in data.runs:
        return
    run, reference = data.runs[SLIPPERY], data.version.reference
    gates = opening(data.version.manifest, run)
    if not gates:
        return
    line = Line(reference, reference, "model_3")
    ours, one_instant = (run.results[name].whole for name in (reference, data.choice))
    yield Picture(
        "road-gates",
        "Adhesion 0.4 and the gates",
        f"{line.label} is several linear models with a blend between them: root mean square error "
        f"{degrees(ours.rmse_deg)}, {degrees(one_instant.rmse_deg)} by the paper's model. "
        "Beneath: how far each gate is open, from its first knot to its last. Where the car is "
        "unstable is shaded.",
        "The true and the estimated angle over time, a strip for each gate.",
        lambda size: angle_and_gates(run, line, gates, size),
    )


def fleet_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the fleet car by car before and after calibration; none without a fleet."""
    cars = data.cars
    if cars is None:
        return
    better = float((cars.after_deg < cars.before_deg).mean())
    yield Picture(
        "fleet-cars",
        "A fleet car by car, before and after calibration",
        f"{count(len(cars.before_deg))} cars of the campaign {cars.campaign}, each estimated by a "
        "model that was fitted on others. Root mean square error of all rows: "
        f"{degrees(cars.all_before_deg)} with {cars.inputs_before} inputs, "
        f"{degrees(cars.all_after_deg)} with {cars.inputs_after}, among them what the car's own "
        f"drives tell of its sensors and tyres without a label. {percent(better)} of the cars "
        "gain.",
        "Two points for each car, in the order of the error without.",
        lambda size: car_by_car(cars, size),
    )


FILTER = "ekf_told_tuned"
"""The best filter: an extended Kalman filter that knows the car."""

LINES = {
    "nominal": ("nominal drive", "model_4"),
    "melbourne": ("Melbourne", "model_3"),
    "noise_doubled": ("noise doubled", "model_2"),
    "style_sporty": ("sporty driver", "kalman"),
}


def memory_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the figures on memory; none if the published model has none."""
    if data.memory is not None:
        yield _by_columns(data, data.memory)
        yield _left_out(data, data.memory)
        if "nominal" in data.runs:
            yield _on_the_track(data)


def _by_columns(data: ReportData, memory: Memory) -> Picture:
    known = data.evaluated.figures("nominal", FILTER)
    filter_deg = known.rmse_deg if known else None
    lines = [Series("cross-validated", "ink", memory.cross_validated_deg)]
    for name, errors in memory.on_drives.items():
        mark = filter_deg if name == "nominal" else None
        lines.append(Series(*LINES[name], errors, mark))
    found = memory.searched
    return Picture(
        "memory-columns",
        "Error by number of columns",
        f"Models of 1 to {len(found.models)} columns that a search by {found.search.method} finds "
        f"among {len(found.inputs)} inputs on the training drives alone; the test drives only "
        f"judge. {_smallest(memory, filter_deg)} Cross-validated errors have the noise of the "
        "training drives' labels in them, test drives have none.",
        f"A falling line for each of {listed([line.label for line in lines])}.",
        lambda size: error_by_columns(lines, size),
    )


def _smallest(memory: Memory, filter_deg: float | None) -> str:
    """Tell the fewest columns that are more accurate than the filter on the nominal drive."""
    if filter_deg is None or "nominal" not in memory.on_drives:
        return ""
    errors = memory.on_drives["nominal"]
    known = f"an extended Kalman filter that knows the car ({degrees(filter_deg)}, dashed)"
    if not (errors < filter_deg).any():
        return f"None is more accurate than {known} on the nominal drive."
    first = int(np.argmax(errors < filter_deg))
    columns = list(memory.searched.models[first].signals)
    fewest = f"{len(columns)} columns are" if len(columns) > 1 else "One column is"
    return (
        f"{fewest} enough to be more accurate than {known} on the nominal drive: "
        f"{listed(columns)}, with {degrees(errors[first])}."
    )


def _left_out(data: ReportData, memory: Memory) -> Picture:
    dearest = memory.columns[0]
    window = max(memory.windows, key=lambda one: one.rmse_deg, default=None)
    of_lengths = (
        f"Of the lengths it is {window.name}: {degrees(window.rmse_deg, 4)}. " if window else ""
    )
    return Picture(
        "memory-left-out",
        "What each column and each window buys",
        f"Cross-validated RMSE of the columns of {data.version.reference} as they stand, "
        f"{degrees(memory.rmse_deg, 4)}, and what it rises to when a column, or all windows of one "
        f"length, is left out and the rest is fitted again. The dearest column is {dearest.name}: "
        f"{degrees(dearest.rmse_deg, 4)} without it. {of_lengths}A column that costs little may "
        "still be the best of several that say nearly the same.",
        "Bars.",
        lambda size: left_out(memory, size),
    )


def _on_the_track(data: ReportData) -> Picture:
    run, published = data.runs["nominal"], data.version.reference
    maps = [
        Map(f"Model {data.choice_number}, one instant", run, data.choice),
        Map(f"{published}, with memory", run, published),
    ]
    before, after = (run.results[one.estimator].whole.rmse_deg for one in maps)
    return Picture(
        "memory-map",
        "Where on the track memory helps",
        "The nominal drive, by the model of one instant and by the published one. Blue: the "
        "estimate is too far to the right; orange: too far to the left. Root mean square error "
        f"{degrees(before)} and {degrees(after)}.",
        "Two maps of the track, coloured by the error.",
        lambda size: error_map(maps, size, FINE_EDGES_DEG),
    )
