"""The report: one static page without a request to anywhere, and its figures as files."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import MEASURED
from fleet_slip.evaluation.charts import DRAWN_SCENARIOS, draw_pictures
from fleet_slip.evaluation.claims import Status, evaluate_claims
from fleet_slip.evaluation.evaluation_document import evaluations_of
from fleet_slip.evaluation.evaluator import Estimator, evaluate
from fleet_slip.evaluation.filters import LinearEstimate, restore_filter, train_models
from fleet_slip.evaluation.report_data import (
    DRAWN_FILTERS,
    PAPER_TABLE_TWO,
    ReportData,
    StoredEvaluation,
    compare_orders,
    latest_evaluation,
)
from fleet_slip.evaluation.scenario_evaluation import MIN_COVERAGE
from fleet_slip.evaluation.test_drives import TestDrive, simulate_drives
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.drawing import Drawn, draw
from fleet_slip.pages.page import (
    Cell,
    ReportTable,
    Tile,
    count,
    degrees,
    fill_in,
    number,
    percent,
)
from fleet_slip.simulation.scenario import load_scenarios
from fleet_slip.storage.folder import Folder
from fleet_slip.warehouse.warehouse import Warehouse

PAPER_TABLE_ONE = {"1": 0.9013, "2": 0.9534, "3": 0.9796, "4": 0.9911, "5": 0.9911}
"""Cross-validated correlations, Table I."""


def gather(warehouse: Warehouse, version: ModelVersion) -> ReportData:
    """Gather the data of a report about a model version.

    Raises `DataError` if the version has not been evaluated, or if its cohort or a drive of a
    scenario has changed since: all numbers of a report are of the same data.
    """
    evaluated = latest_evaluation(warehouse, version)
    trained = train_models(warehouse, version)
    evaluated.require_models(trained)
    shipped = load_scenarios(warehouse.configs)
    names = DRAWN_SCENARIOS.intersection(evaluated.scenarios)
    drawn = [scenario for scenario in shipped if scenario.name in names]
    drives = simulate_drives(warehouse.catalog.signals, drawn)
    runs = {run.name: run for run in evaluate(drives, _drawn_estimators(evaluated))}
    evaluated.require_errors(runs)
    cohort, models = trained.selection.cohort, trained.selection.models
    measured = evaluations_of(warehouse, "measured")
    contents = (measured.read(number).content for number in reversed(measured.numbers()))
    return ReportData(
        version=version,
        evaluated=evaluated,
        trained=trained,
        runs=runs,
        orders=compare_orders(cohort, tuple(dict.fromkeys(models[-1].signals))),
        on_measured=next((c for c in contents if c["model"] == version.reference), None),
        shipped=tuple(scenario.name for scenario in shipped),
    )


def _drawn_estimators(evaluated: StoredEvaluation) -> dict[str, Estimator[TestDrive]]:
    """Restore the estimators that figures show from their descriptions in the evaluation."""
    about = evaluated.estimators
    models = {
        name: LinearEstimate(about[name]["intercept"], about[name]["coefficients"])
        for name in evaluated.models.values()
    }
    filters = {name: restore_filter(name, about[name]) for name in DRAWN_FILTERS if name in about}
    return {**models, **filters}


def _marked(text: str, good: bool, miss: bool = False) -> Cell:
    cell = Cell(text)
    cell.mark = "good" if good else "miss" if miss else ""
    return cell


def table_one(data: ReportData) -> ReportTable:
    """Return Table I."""
    head = ["model", "signals", "paper", "ours", "standard error", "RMSE"]
    rows: list[list[str]] = []
    for row in data.trained.selection.models:
        paper = PAPER_TABLE_ONE.get(row.name)
        ours = _marked(number(row.correlation, 4), paper is not None and row.correlation >= paper)
        error, rmse = f"± {number(row.standard_error, 4)}", degrees(row.pooled.rmse_deg)
        rows.append([row.name, ", ".join(row.signals), number(paper, 4), ours, error, rmse])
    selection = data.trained.selection
    noise = data.version.manifest.cross_validation.label_noise_deg
    note = (
        f"{selection.folds.count} folds by {selection.folds.by}, {count(selection.cohort.rows)} "
        f"rows. {selection.winner.reason} "
    )
    if noise is None:
        note += "The label noise is unknown; every RMSE here includes it."
    else:
        note += f"Every RMSE here includes the label noise, {degrees(noise, 4)}."
    caption = "Table I. Properties of the estimation models: cross-validated correlation"
    return ReportTable("table-1", caption, head, rows, text_columns=2, note=note)


def table_two(data: ReportData) -> ReportTable:
    """Return Table II: the errors on the nominal test drive."""
    rows: list[list[str]] = []
    for name, estimator in data.evaluated.models.items():
        errors = data.evaluated.statistics("nominal", estimator)
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


def standings(data: ReportData) -> ReportTable:
    """Return every estimator's error on every test drive; of Table I the paper's choice alone."""
    evaluated = data.evaluated
    omitted = set(evaluated.models.values()) - {data.choice}
    names = [name for name in evaluated.estimators if name not in omitted]
    rows: list[list[str]] = []
    for scenario in evaluated.scenarios:
        errors, texts = {}, {}
        for name in names:
            statistics = evaluated.statistics(scenario, name)
            rmse_deg = statistics.rmse_deg if statistics else None
            texts[name] = number(rmse_deg)
            if statistics and rmse_deg is not None:
                if statistics.coverage >= MIN_COVERAGE:
                    errors[name] = rmse_deg
                else:
                    texts[name] += f" ({percent(statistics.coverage)})"
        best = min(errors.values(), default=None)
        rows.append(
            [scenario, *(_marked(texts[n], n in errors and errors[n] == best) for n in names)]
        )
    ranking = evaluated.document.content["ranking"]
    return ReportTable(
        "standings",
        "Every estimator on every test drive: root mean square error in degrees",
        ["test drive", *names],
        rows,
        lead=f"Of all estimators without GPS, `{ranking['estimator']}` has the smallest error on "
        f"{ranking['won']} of {ranking['drives']} drives, and at most {ranking['close_ratio']} "
        f"times the smallest on {ranking['close']} more.",
        note="Green: the smallest of the row. Drives that differ only in GPS count once. An "
        "estimator with a percentage covers this share of the drive, and does not compete.",
    )


def measured_drives(data: ReportData) -> list[ReportTable]:
    """Return the errors on measured drives, if they were evaluated."""
    content = data.on_measured
    if content is None:
        return []
    rows = [
        [
            name,
            row["told"],
            _marked(degrees(row["rmse_deg"]), place == 0),
            degrees(row["error_mean_deg"], sign=True),
            degrees(row["error_std_deg"]),
            number(row["correlation"]),
            percent(row["coverage"]),
        ]
        for place, (name, row) in enumerate(content["estimators"].items())
    ]
    return [
        ReportTable(
            "own-car",
            "Measured drives with a label",
            ["estimator", "source", "RMSE", "mean", "error std", "correlation", "rows"],
            rows,
            text_columns=2,
            note=f"{count(len(content['drives']))} drives, held out by {content['parts_of']}: "
            f"{content['cohort']}. Green: the smallest.",
        )
    ]


def render(data: ReportData, pictures: Sequence[Drawn]) -> str:
    """Return the page."""
    claims = evaluate_claims(data)
    counted = Counter(claim.status for claim in claims)
    return fill_in(
        "report.html.j2",
        version=data.version,
        evaluation=data.evaluated.document,
        paper=pictures,
        tables=[table_one(data), table_two(data)],
        further=[*measured_drives(data), standings(data)],
        tiles=_tiles(data, counted),
        claims=claims,
        present={"table-1", "table-2", *(drawn.picture.key for drawn in pictures)},
        tally={status: counted[status] for status in Status},
        measured=MEASURED in data.trained.selection.cohort.drives["source"].to_pylist(),
        missing=[name for name in data.shipped if name not in data.evaluated.scenarios],
        cohort=data.trained.selection.cohort,
        commands=_commands(data),
    )


def _tiles(data: ReportData, tally: Mapping[Status, int]) -> list[Tile]:
    drives = pluralize(data.version.manifest.trained_on.drives, "drive")
    tiles = [
        Tile(
            f"{tally[Status.REPRODUCED]} of "
            f"{tally[Status.REPRODUCED] + tally[Status.NOT_REPRODUCED]}",
            f"testable claims reproduced; {tally[Status.NOT_TESTABLE]} cannot be tested here",
        ),
        Tile(count(data.version.manifest.trained_on.rows), f"training rows of {drives}"),
    ]
    names = (data.version.reference, data.choice)
    both = [data.evaluated.statistics("nominal", name) for name in names]
    reported, chosen = (errors.error_std_deg if errors else None for errors in both)
    if reported is not None and chosen is not None:
        label = (
            f"error std of {data.version.reference} on the nominal drive; of model "
            f"{data.choice_number} {degrees(chosen)}, in the paper "
            f"{degrees(PAPER_TABLE_TWO[data.choice_number][1])}"
        )
        tiles.append(Tile(degrees(reported), label))
    return tiles


def _commands(data: ReportData) -> list[str]:
    reference, drives = data.version.reference, data.trained.selection.cohort.drives
    pairs = zip(drives["source"].to_pylist(), drives["campaign"].to_pylist(), strict=True)
    rows = data.evaluated.document.content["comparisons"]
    fleets = dict.fromkeys(row["fleet"].rpartition("/")[0] for row in rows)
    measured = f"fleet-slip learn {data.version.manifest.name} LOGS --mapping"
    return [
        *(
            f"{measured if source == MEASURED else 'fleet-slip run --campaign'} {name}"
            for source, name in sorted({*pairs})
        ),
        f"fleet-slip evaluate {reference}{''.join(f' --compare {name}' for name in fleets)}",
        f"fleet-slip report {reference}",
    ]


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
