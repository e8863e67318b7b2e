"""Figures beyond the paper: where and when estimates are off, a fleet's cars."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.comparison.evaluation.ranking import LEAST_COVERAGE
from fleet_slip.comparison.report.error_charts import (
    Series,
    car_by_car,
    error_by_acceleration,
    error_over,
)
from fleet_slip.comparison.report.gate_strips import angle_and_gates, opening
from fleet_slip.comparison.report.paper_pictures import (
    FILTER_LABELS,
    choice_line,
    model_line,
    paper_pictures,
)
from fleet_slip.comparison.report.point_charts import Named, points_by_drive
from fleet_slip.comparison.report.report_data import DRAWN_FILTERS, TRAINED_SHARE, ReportData
from fleet_slip.comparison.report.report_tables import compared, won
from fleet_slip.comparison.report.texts import TEXTS, read_toml
from fleet_slip.comparison.report.time_series import Line
from fleet_slip.comparison.report.track_map import Map, error_map
from fleet_slip.pages.drawing import Picture, Size

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
