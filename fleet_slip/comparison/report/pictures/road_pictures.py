"""Figures on roads and hard driving: what gates do, and who is best where."""

from collections.abc import Iterator, Sequence

from fleet_slip.comparison.evaluation.errors import ErrorFigures
from fleet_slip.comparison.evaluation.ranking import LEAST_COVERAGE
from fleet_slip.comparison.report.figures.gates import angle_and_gates
from fleet_slip.comparison.report.figures.series import Line
from fleet_slip.comparison.report.figures.standings import Named, points_by_drive
from fleet_slip.comparison.report.findings.gate_openings import opening
from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.pages.picture import Picture
from fleet_slip.pages.table import Cell, ReportTable, table
from fleet_slip.pages.text import degrees, number, percent

SLIPPERY = "adhesion_0_4"


def road_pictures(data: ReportData) -> Iterator[Picture]:
    """Return the slippery drive with the gates of the published model; none without gates."""
    if SLIPPERY not in data.runs:
        return
    run, manifest = data.runs[SLIPPERY], data.version.manifest
    gates = opening(manifest, run)
    if not gates:
        return
    line = Line(data.version.reference, data.version.reference, "model_3")
    figures = run.results[line.estimator].whole
    one_instant = run.results[data.choice].whole
    title = "Adhesion 0.4 and the gates"
    caption = (
        f"{line.label} is several linear models with a blend between them: root mean square error "
        f"{degrees(figures.rmse_deg)}, {degrees(one_instant.rmse_deg)} by the paper's model. "
        "Beneath: how far each gate is open, from its first knot to its last. Where the car is "
        "unstable is shaded."
    )
    yield Picture(
        "road-gates",
        title,
        caption,
        f"{title}: the true and the estimated angle over time, a strip for each gate. {caption}",
        lambda size: angle_and_gates(run, line, gates, size),
    )


def standings_picture(data: ReportData) -> Picture:
    """Return every estimator on every test drive as points."""
    evaluated = data.evaluated
    choices = [
        Named(data.version.reference, data.version.reference, "model_3"),
        Named(data.choice, f"Model {data.choice_number}", "model_4"),
        Named("ekf_class_tuned", "EKF told the class, tuned", "kalman"),
        Named("ekf_told_tuned", "EKF told everything, tuned", "model_2"),
    ]
    shown = _compared(data)
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
    title = "Every estimator on every test drive"
    caption = (
        f"The further to the left, the better. {_won(data)}Who has estimates for less than "
        f"{percent(LEAST_COVERAGE)} of a drive is not drawn there."
    )
    return Picture(
        "test-drives",
        title,
        caption,
        f"{title}: a row for each test drive, a point for the error of each estimator. {caption}",
        lambda size: points_by_drive(errors, [n for n in choices if n.estimator in shown], size),
    )


def _compared(data: ReportData) -> list[str]:
    """Return the estimators that stand beside each other: of Table I the paper's choice alone."""
    left_out = set(data.evaluated.models.values()) - {data.choice}
    return [name for name in data.evaluated.estimators if name not in left_out]


def standings(data: ReportData) -> ReportTable:
    """Return the RMSE of every estimator on every test drive, the smallest marked."""
    evaluated = data.evaluated
    names = _compared(data)
    rows: list[list[str | Cell]] = [
        [scenario, *_row([evaluated.figures(scenario, name) for name in names])]
        for scenario in evaluated.scenarios
    ]
    return table(
        "standings",
        "Every estimator on every test drive: root mean square error in degrees",
        ["test drive", *names],
        rows,
        note=f"Green: the smallest of the row. {_won(data)}A percentage: the share of the drive "
        "with an estimate; such do not compete.",
    )


def _row(found: Sequence[ErrorFigures | None]) -> list[Cell]:
    errors = [one.rmse_deg if one and one.coverage >= LEAST_COVERAGE else None for one in found]
    least = min((error for error in errors if error is not None), default=None)
    cells = []
    for one, error in zip(found, errors, strict=True):
        if error is None and one is not None and one.rmse_deg is not None:
            cells.append(Cell(f"{number(one.rmse_deg)} ({percent(one.coverage)})"))
        else:
            best = error is not None and error == least
            cells.append(Cell(number(error), "good" if best else ""))
    return cells


def _won(data: ReportData) -> str:
    found = data.evaluated.document.content.get("ranking")
    if found is None:
        return ""
    return (
        f"Among all without satellite navigation {found['estimator']} wins {found['won']} of "
        f"{found['drives']} drives, and comes within {found['close_ratio']} times the winner in "
        f"{found['close']} more. "
    )
