"""Figures beyond the paper: where and when estimates are off, what memory buys, a fleet's cars."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

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
from fleet_slip.comparison.report.texts import TEXTS, read_toml
from fleet_slip.comparison.report.time_series import Line
from fleet_slip.comparison.report.track_map import FINE_EDGES_DEG, Map, error_map
from fleet_slip.pages.drawing import Picture, Size

SLIPPERY = "adhesion_0_4"
STYLES = ("style_gentle", "nominal", "style_brisk", "style_sporty", "style_limit")
"""Drives of the training car on a dry road, from slow to the limit."""

TRAINED_SHARE = 0.999

PICTURES = read_toml("pictures.toml")


def draw_pictures(data: ReportData) -> tuple[Picture, ...]:
    """Return all figures whose drives were evaluated, with captions from the same data."""
    parts = (paper_pictures, further_pictures, memory_pictures, road_pictures, fleet_pictures)
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
    choice, histogram = choice_line(data).label, data.histogram
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
    yield _picture(
        "density",
        lambda size: density(histogram, size),
        choice=choice,
        rows=int(histogram.rows.sum()),
        model=next(m for m in data.trained.selection.models if f"Model {m.name}" == choice),
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
    trained_to = data.histogram.trained_to_mps2(TRAINED_SHARE)
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
    if (memory := data.memory) is None:
        return
    yield _by_columns(data, memory)
    published = data.version.reference
    yield _picture(
        "memory-left-out", lambda size: left_out(memory, size), reference=published, memory=memory
    )
    if "nominal" in data.runs:
        run = data.runs["nominal"]
        maps = [
            Map(f"Model {data.choice_number}, one instant", run, data.choice),
            Map(f"{published}, with memory", run, published),
        ]
        yield _picture(
            "memory-map",
            lambda size: error_map(maps, size, FINE_EDGES_DEG),
            before=run.results[data.choice].whole,
            after=run.results[published].whole,
        )


def _by_columns(data: ReportData, memory: Memory) -> Picture:
    known = data.evaluated.figures("nominal", FILTER)
    known_deg = known.rmse_deg if known else None
    lines = [Series("cross-validated", "ink", memory.cross_validated_deg)]
    for name, errors in memory.on_drives.items():
        lines.append(Series(*LINES[name], errors, known_deg if name == "nominal" else None))
    nominal = memory.on_drives.get("nominal", np.empty(0))
    better = [] if known_deg is None else np.flatnonzero(nominal < known_deg).tolist()
    return _picture(
        "memory-columns",
        lambda size: error_by_columns(lines, size),
        found=memory.searched,
        known_deg=known_deg if len(nominal) else None,
        fewest=list(memory.searched.models[better[0]].signals) if better else None,
        fewest_deg=float(nominal[better[0]]) if better else None,
        labels=[line.label for line in lines],
    )
