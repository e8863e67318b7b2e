"""The report: one static page without a request to anywhere, and its figures as files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import MEASURED
from fleet_slip.evaluation.charts import DRAWN_SCENARIOS, draw_pictures
from fleet_slip.evaluation.claims import CLAIMS, PAPER_TABLE_TWO, Status, evaluate_claim
from fleet_slip.evaluation.evaluated_drives import TestDrive, simulate_drives
from fleet_slip.evaluation.evaluation_document import DRAWN_FILTERS, ReportData, latest_evaluation
from fleet_slip.evaluation.evaluator import Estimator, evaluate
from fleet_slip.evaluation.filters import linear_estimate, restore_filter, train_models
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.page import (
    Cell,
    Drawn,
    ReportTable,
    count,
    degrees,
    draw,
    fill_in,
    number,
)
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.storage.folder import Folder
from fleet_slip.warehouse.warehouse import Warehouse

PAPER_TABLE_ONE = {"1": 0.9013, "2": 0.9534, "3": 0.9796, "4": 0.9911, "5": 0.9911}
"""Cross-validated correlations, Table I."""


def gather(warehouse: Warehouse, version: ModelVersion) -> ReportData:
    """Gather the data of a report about a model version.

    Raises `DataError` if the version has not been evaluated, or if its cohort or a drive of a
    scenario has changed since: all numbers of a report are of the same data.
    """
    document, trained = latest_evaluation(warehouse, version), train_models(warehouse, version)
    data = ReportData(version, document, trained, {})
    names = [name for name in data.scenarios if name in DRAWN_SCENARIOS]
    scenarios = [load_scenario(name, warehouse.configs) for name in names]
    about = data.estimators
    estimators: dict[str, Estimator[TestDrive]] = {
        name: partial(linear_estimate, about[name]["intercept"], about[name]["coefficients"])
        for name in data.models.values()
    }
    for name in DRAWN_FILTERS:
        if name in about:
            estimators[name] = restore_filter(name, about[name])
    drives = simulate_drives(warehouse.catalog.signals, scenarios)
    data = replace(data, runs={run.name: run for run in evaluate(drives, estimators)})
    data.require_unchanged()
    return data


def table_one(data: ReportData) -> ReportTable:
    """Return Table I."""
    head = ["model", "signals", "paper", "ours", "standard error", "RMSE"]
    rows: list[list[str]] = []
    selection = data.trained.selection
    for row in selection.models:
        paper, ours = PAPER_TABLE_ONE.get(row.name), number(row.correlation, 4)
        if paper is not None and row.correlation >= paper:
            ours = Cell(ours)
        error, rmse = f"± {number(row.standard_error, 4)}", degrees(row.pooled.rmse_deg)
        rows.append([row.name, ", ".join(row.signals), number(paper, 4), ours, error, rmse])
    noise = data.version.manifest.cross_validation.label_noise_deg
    folds = selection.candidate_list.folds
    note = (
        f"{folds.count} folds by {folds.by}, {count(selection.cohort.rows)} "
        f"rows. {selection.winner.reason} Every RMSE includes the label noise: "
        f"{'unknown' if noise is None else degrees(noise, 4)}."
    )
    caption = "Table I. Properties of the estimation models: cross-validated correlation"
    return ReportTable("table-1", caption, head, rows, text_columns=2, note=note)


def table_two(data: ReportData) -> ReportTable:
    """Return Table II: the errors on the nominal test drive."""
    rows: list[list[str]] = []
    for name, estimator in data.models.items():
        errors = data.statistics("nominal", estimator)
        if errors is None or errors.error_std_deg is None:
            continue
        mean, std = PAPER_TABLE_TWO[name]
        means = (number(value, 4, sign=True) for value in (mean, errors.error_mean_deg))
        ours, correlation = number(errors.error_std_deg, 4), number(errors.correlation, 4)
        if errors.error_std_deg <= std:
            ours = Cell(ours)
        rows.append([name, *means, number(std, 4), ours, correlation])
    head = ["model", "mean, paper", "mean, ours", "std, paper", "std, ours", "correlation, ours"]
    caption = "Table II. Predictive accuracy on the nominal test drive: error in degrees"
    return ReportTable("table-2", caption, head, rows)


def render(data: ReportData, pictures: Sequence[Drawn]) -> str:
    """Return the page."""
    claims = [evaluate_claim(claim, data) for claim in CLAIMS]
    tally = {status: sum(claim.status == status for claim in claims) for status in Status}
    cohort, reference = data.trained.selection.cohort, data.version.reference
    trained, reproduced = data.version.manifest.trained_on, tally[Status.REPRODUCED]
    testable = reproduced + tally[Status.NOT_REPRODUCED]
    untested = f"testable claims reproduced; {tally[Status.NOT_TESTABLE]} cannot be tested here"
    tiles = {
        untested: f"{reproduced} of {testable}",
        f"training rows of {pluralize(trained.drives, 'drive')}": count(trained.rows),
    }
    errors = data.statistics("nominal", reference)
    if errors and errors.error_std_deg is not None:
        tiles[f"error std of {reference} on the nominal drive"] = degrees(errors.error_std_deg)
    shipped = data.version.catalog.configs.names("scenarios")
    return fill_in(
        "report.html.j2",
        version=data.version,
        evaluation=data.document,
        paper=pictures,
        tables=[table_one(data), table_two(data)],
        tiles=tiles,
        claims=claims,
        present={"table-1", "table-2", *(drawn.picture.key for drawn in pictures)},
        tally=tally,
        measured=MEASURED in cohort.drives["source"].to_pylist(),
        missing=[name for name in shipped if name not in data.scenarios],
        cohort=cohort,
        commands=[f"fleet-slip evaluate {reference}", f"fleet-slip report {reference}"],
    )


PAGE = "report.html"
FIGURES = "figures"


@dataclass(frozen=True)
class WrittenReport:
    """The files of a report.

    Attributes
    ----------
    page
        Path or URL of the page.
    size_bytes
        Size of the page.
    figures
        Number of figures, each an SVG and a PNG file.
    """

    page: str
    size_bytes: int
    figures: int

    @property
    def figures_folder(self) -> str:
        """Folder of the figures."""
        return f"{self.page.removesuffix(PAGE)}{FIGURES}"


def write_report(warehouse: Warehouse, version: ModelVersion, output: Folder) -> WrittenReport:
    """Write the report into a folder, the page last. Raises `DataError` if not evaluated."""
    data = gather(warehouse, version)
    pictures = tuple(map(draw, draw_pictures(data)))
    page = render(data, pictures).encode("utf-8")
    for drawn in pictures:
        output.put(f"{FIGURES}/{drawn.picture.key}.svg", drawn.svg_file.encode("utf-8"))
        output.put(f"{FIGURES}/{drawn.picture.key}.png", drawn.png_file)
    output.put(PAGE, page)
    return WrittenReport(f"{output}/{PAGE}", len(page), len(pictures))
