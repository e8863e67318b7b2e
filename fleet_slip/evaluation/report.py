"""The report: one static page without a request to anywhere, and its figures as files."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import MEASURED
from fleet_slip.evaluation.charts import DRAWN_SCENARIOS, draw_pictures
from fleet_slip.evaluation.claims import CLAIMS, PAPER_TABLE_TWO, Status, evaluate_claim
from fleet_slip.evaluation.evaluation_document import DRAWN_FILTERS, ReportData, latest_evaluation
from fleet_slip.evaluation.evaluator import Estimator, evaluate
from fleet_slip.evaluation.filters import linear_estimate, restore_filter, train_models
from fleet_slip.evaluation.test_drives import TestDrive, simulate_drives
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.page import (
    Cell,
    Drawn,
    ReportTable,
    Tile,
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
    drives = simulate_drives(warehouse.catalog.signals, scenarios)
    data = replace(data, runs={r.name: r for r in evaluate(drives, _drawn_estimators(data))})
    data.require_unchanged()
    return data


def _drawn_estimators(data: ReportData) -> dict[str, Estimator[TestDrive]]:
    """Restore the estimators that figures show from their descriptions in the evaluation."""
    about = data.estimators
    models = {
        name: partial(linear_estimate, about[name]["intercept"], about[name]["coefficients"])
        for name in data.models.values()
    }
    filters = {name: restore_filter(name, about[name]) for name in DRAWN_FILTERS if name in about}
    return {**models, **filters}


def _marked(text: str, good: bool) -> Cell:
    cell = Cell(text)
    cell.mark = "good" if good else ""
    return cell


def table_one(data: ReportData) -> ReportTable:
    """Return Table I."""
    head = ["model", "signals", "paper", "ours", "standard error", "RMSE"]
    rows: list[list[str]] = []
    selection = data.trained.selection
    for row in selection.models:
        paper = PAPER_TABLE_ONE.get(row.name)
        ours = _marked(number(row.correlation, 4), paper is not None and row.correlation >= paper)
        error, rmse = f"± {number(row.standard_error, 4)}", degrees(row.pooled.rmse_deg)
        rows.append([row.name, ", ".join(row.signals), number(paper, 4), ours, error, rmse])
    noise = data.version.manifest.cross_validation.label_noise_deg
    noise_text = "unknown" if noise is None else degrees(noise, 4)
    folds = selection.compared.folds
    note = (
        f"{folds.count} folds by {folds.by}, {count(selection.cohort.rows)} "
        f"rows. {selection.winner.reason} Every RMSE includes the label noise: {noise_text}."
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
        rows.append(
            [
                name,
                number(mean, 4, sign=True),
                number(errors.error_mean_deg, 4, sign=True),
                number(std, 4),
                _marked(number(errors.error_std_deg, 4), errors.error_std_deg <= std),
                number(errors.correlation, 4),
            ]
        )
    head = ["model", "mean, paper", "mean, ours", "std, paper", "std, ours", "correlation, ours"]
    caption = "Table II. Predictive accuracy on the nominal test drive: error in degrees"
    return ReportTable("table-2", caption, head, rows)


def render(data: ReportData, pictures: Sequence[Drawn]) -> str:
    """Return the page."""
    claims = [evaluate_claim(claim, data) for claim in CLAIMS]
    counted = Counter(claim.status for claim in claims)
    cohort = data.trained.selection.cohort
    shipped = data.version.catalog.configs.names("scenarios")
    reference = data.version.reference
    return fill_in(
        "report.html.j2",
        version=data.version,
        evaluation=data.document,
        paper=pictures,
        tables=[table_one(data), table_two(data)],
        tiles=_tiles(data, counted),
        claims=claims,
        present={"table-1", "table-2", *(drawn.picture.key for drawn in pictures)},
        tally={status: counted[status] for status in Status},
        measured=MEASURED in cohort.drives["source"].to_pylist(),
        missing=[name for name in shipped if name not in data.scenarios],
        cohort=cohort,
        commands=[f"fleet-slip evaluate {reference}", f"fleet-slip report {reference}"],
    )


def _tiles(data: ReportData, tally: Counter[Status]) -> list[Tile]:
    trained, reproduced = data.version.manifest.trained_on, tally[Status.REPRODUCED]
    tiles = [
        Tile(
            f"{reproduced} of {reproduced + tally[Status.NOT_REPRODUCED]}",
            f"testable claims reproduced; {tally[Status.NOT_TESTABLE]} cannot be tested here",
        ),
        Tile(count(trained.rows), f"training rows of {pluralize(trained.drives, 'drive')}"),
    ]
    errors = data.statistics("nominal", data.version.reference)
    if errors and errors.error_std_deg is not None:
        label = f"error std of {data.version.reference} on the nominal drive"
        tiles.append(Tile(degrees(errors.error_std_deg), label))
    return tiles


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
