"""Tables of what a model was learned from, and of measured drives that judge it."""

from collections.abc import Iterator

from fleet_slip.comparison.report.report_data import ReportData
from fleet_slip.pages.page_parts import Cell, ReportTable, count, degrees, number, percent, table


def without_label(data: ReportData) -> Iterator[ReportTable]:
    """Yield what a model was learned from instead of a label, or beside it."""
    manifest = data.version.manifest
    learned, figures = manifest.learned_from, manifest.cross_validation
    if learned is None:
        return
    alone = (
        "No reference sensor taught this model: the change of the course less the integral of the "
        "yaw rate stood for the label. Where this page compares with a label, the model has never "
        "seen it."
    )
    beside = "Cars with a reference sensor taught this model, and cars with the course alone."
    times = learned.change_s if isinstance(learned.change_s, tuple) else (learned.change_s,)
    yield table(
        "without-label",
        "Learned from the course",
        ["what", "figure"],
        [
            ["seconds over which the course changes", ", ".join(f"{t:g}" for t in times)],
            ["error of changes, held out", degrees(figures.rmse_deg)],
            ["correlation of changes, held out", number(figures.correlation, 4)],
            ["cars that tell the intercept", count(learned.cars)],
            ["uncertainty of the intercept", degrees(learned.intercept_uncertainty_deg)],
            ["difference between cars", degrees(learned.intercept_spread_deg)],
        ],
        note=(
            f"{alone if learned.label == 'course' else beside} Errors of changes have the noise of "
            "two fixes in them."
        ),
    )


def own_car(data: ReportData) -> Iterator[ReportTable]:
    """Yield the latest figures of a model on measured drives, if it was judged on any."""
    content = data.on_measured
    if content is None:
        return
    estimators = content["estimators"]
    least = next(iter(estimators), None)
    yield table(
        "own-car",
        "A car of one's own: measured drives with a label",
        ["estimator", "knows", "RMSE", "mean", "error std", "correlation", "rows"],
        [
            [
                name,
                one["told"],
                Cell(degrees(one["rmse_deg"]), "good" if name == least else ""),
                degrees(one["error_mean_deg"], sign=True),
                degrees(one["error_std_deg"]),
                number(one["correlation"]),
                percent(one["coverage"]),
            ]
            for name, one in estimators.items()
        ],
        left=2,
        note=(
            f"Each quarter of the {content['parts_of']} of {count(len(content['drives']))} drives "
            f"left out in turn: {content['cohort']}. Green: the smallest."
        ),
    )
