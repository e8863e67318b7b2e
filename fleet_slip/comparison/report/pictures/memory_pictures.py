"""Figures that tell what memory buys: by number of columns, by column and window, on the track."""

from collections.abc import Iterator

import numpy as np

from fleet_slip.comparison.report.figures.column_errors import Series, error_by_columns, left_out
from fleet_slip.comparison.report.figures.track_map import FINE_EDGES_DEG, Map, error_map
from fleet_slip.comparison.report.findings.memory import Memory, Without
from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.pages.picture import Picture
from fleet_slip.pages.text import degrees, listed

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
    filter_deg = _rmse(data, FILTER)
    lines = [Series("cross-validated", "ink", memory.cross_validated_deg)]
    for name, errors in memory.on_drives.items():
        mark = filter_deg if name == "nominal" else None
        lines.append(Series(*LINES[name], errors, mark))
    found = memory.searched
    caption = (
        f"Models of 1 to {len(found.models)} columns that a search by {found.search.method} finds "
        f"among {found.inputs} inputs on the training drives alone; the test drives only judge. "
        f"{_smallest(memory, filter_deg)} Cross-validated errors have the noise of the training "
        "drives' labels in them, test drives have none."
    )
    return Picture(
        "memory-columns",
        "Error by number of columns",
        caption,
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
    caption = (
        f"Cross-validated RMSE of the columns of {data.version.reference} as they stand, "
        f"{degrees(memory.rmse_deg, 4)}, and what it rises to when a column, or all windows of one "
        f"length, is left out and the rest is fitted again. The dearest column is {dearest.name}: "
        f"{degrees(dearest.rmse_deg, 4)} without it. {_dearest_window(memory)}A column "
        "that costs little may still be the best of several that say nearly the same."
    )
    return Picture(
        "memory-left-out",
        "What each column and each window buys",
        caption,
        "Bars.",
        lambda size: left_out(memory, size),
    )


def _dearest_window(memory: Memory) -> str:
    if not memory.windows:
        return ""
    dearest: Without = max(memory.windows, key=lambda one: one.rmse_deg)
    return f"Of the lengths it is {dearest.name}: {degrees(dearest.rmse_deg, 4)}. "


def _on_the_track(data: ReportData) -> Picture:
    run, published = data.runs["nominal"], data.version.reference
    label = data.choice_number
    maps = [
        Map(f"Model {label}, one instant", run, data.choice),
        Map(f"{published}, with memory", run, published),
    ]
    before, after = (run.results[one.estimator].whole.rmse_deg for one in maps)
    caption = (
        "The nominal drive, by the model of one instant and by the published one. Blue: the "
        "estimate is too far to the right; orange: too far to the left. Root mean square error "
        f"{degrees(before)} and {degrees(after)}."
    )
    return Picture(
        "memory-map",
        "Where on the track memory helps",
        caption,
        "Two maps of the track, coloured by the error.",
        lambda size: error_map(maps, size, FINE_EDGES_DEG),
    )


def _rmse(data: ReportData, estimator: str) -> float | None:
    found = data.evaluated.figures("nominal", estimator)
    return None if found is None else found.rmse_deg
