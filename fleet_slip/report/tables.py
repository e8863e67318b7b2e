"""The report's tables: the paper's values beside ours, and what the evaluation found beyond."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fleet_slip.evaluation.errors import ErrorFigures
from fleet_slip.evaluation.targets import FILTER_SCENARIOS
from fleet_slip.report.coefficients import Coefficient, Coefficients
from fleet_slip.report.data import ReportData
from fleet_slip.report.text import count, degrees, number, percent, scientific, size
from fleet_slip.signals import catalogue

Mark = Literal["", "good", "miss"]

PAPER_TABLE_ONE = {"1": 0.9013, "2": 0.9534, "3": 0.9796, "4": 0.9911, "5": 0.9911}
"""Cross-validated correlations, Table I."""

PAPER_TABLE_TWO = {
    "1": (0.0135, 0.3018),
    "2": (-0.0146, 0.1754),
    "3": (-0.0209, 0.1556),
    "4": (-0.0060, 0.1549),
    "5": (-0.0079, 0.1505),
}
"""Mean and standard deviation of the error in deg, Table II."""

SHOWN_MODELS = ("1", "2", "4", "5")
"""Model 3 hardly differs from model 2 anywhere."""


@dataclass(frozen=True)
class Cell:
    """One cell: its text, and whether it is marked."""

    text: str
    mark: Mark = ""


@dataclass(frozen=True)
class Table:
    """A table with a caption; the first `left` columns are text, the others are numbers."""

    key: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    left: int = 1
    note: str = ""


def table(
    key: str,
    caption: str,
    head: Sequence[str],
    rows: Sequence[Sequence[str | Cell]],
    *,
    left: int = 1,
    note: str = "",
) -> Table:
    """Return a table of plain texts and marked cells."""
    cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
    return Table(key, caption, head, cells, left, note)


def table_one(data: ReportData) -> Table:
    """Return Table I: cross-validated correlation of the five models."""
    plan = data.trained.selection.folds
    rows: list[list[str | Cell]] = [
        [
            model.name,
            ", ".join(model.signals),
            number(PAPER_TABLE_ONE.get(model.name), 4),
            Cell(
                number(model.correlation, 4),
                "good" if model.correlation >= PAPER_TABLE_ONE.get(model.name, 1) else "",
            ),
            f"± {number(model.standard_error, 4)}",
            degrees(model.pooled.error_std_deg),
        ]
        for model in data.trained.selection.models
    ]
    winner = data.trained.selection.winner.reason
    return table(
        "table-1",
        "Table I. Properties of the estimation models: cross-validated correlation",
        ["model", "signals", "paper", "ours", "standard error", "error std"],
        rows,
        left=2,
        note=(
            f"{plan.count} folds by {plan.by}, {count(data.trained.selection.cohort.rows)} rows. "
            f"{winner}"
        ),
    )


def table_two(data: ReportData) -> Table:
    """Return Table II: mean and standard deviation of the error on the nominal drive."""
    rows: list[list[str | Cell]] = []
    for name, estimator in data.evaluated.models.items():
        figures = data.evaluated.figures("nominal", estimator)
        if figures is None or figures.error_std_deg is None:
            continue
        mean, std = PAPER_TABLE_TWO[name]
        rows.append(
            [
                name,
                number(mean, 4, sign=True),
                number(figures.error_mean_deg, 4, sign=True),
                number(std, 4),
                Cell(
                    number(figures.error_std_deg, 4), "good" if figures.error_std_deg <= std else ""
                ),
                number(figures.correlation, 4),
            ]
        )
    return table(
        "table-2",
        "Table II. Predictive accuracy on the nominal test drive: error in degrees",
        ["model", "mean, paper", "mean, ours", "std, paper", "std, ours", "correlation, ours"],
        rows,
    )


def targets(data: ReportData) -> Iterator[Table]:
    """Return the requirements on the models of Table I, and those against the Kalman filter."""
    checks = data.evaluated.rows("checks")
    models = list(data.evaluated.models.values())
    paper = [one for one in checks if one["scenario"] not in FILTER_SCENARIOS[1:]]
    plain = [one for one in paper if "below that of" not in one["requirement"]]
    against = [one for one in checks if "below that of" in one["requirement"]]
    if plain:
        yield table(
            "targets",
            "What the paper's scenarios ask for, by model of Table I",
            ["requirement", *(f"model {name}" for name in data.evaluated.models)],
            [
                [
                    requirement.replace("_", " "),
                    *(_found(plain, requirement, name) for name in models),
                ]
                for requirement in dict.fromkeys(one["requirement"] for one in plain)
            ],
            note=_misses(plain),
        )
    if against:
        yield table(
            "targets-filter",
            "What the comparison with the Kalman filter asks for",
            ["requirement", "regression", "filter"],
            [
                [
                    one["requirement"].removesuffix(", deg").replace("_", " "),
                    Cell(degrees(one["found"], 4), "good" if one["reached"] else "miss"),
                    degrees(one["limit"], 4),
                ]
                for one in against
            ],
            note=_misses(against),
        )


def _found(checks: Sequence[Mapping[str, Any]], requirement: str, name: str) -> Cell:
    for one in checks:
        if one["requirement"] == requirement and one["estimator"] == name:
            return Cell(number(one["found"], 4), "good" if one["reached"] else "miss")
    return Cell(number(None))


def _misses(checks: Sequence[Mapping[str, Any]]) -> str:
    missed = [one for one in checks if not one["reached"]]
    reached = f"{len(checks) - len(missed)} of {len(checks)} reached."
    told = [
        f"Missed by {one['estimator']} ({one['requirement']}): {one['explanation']}"
        for one in missed
    ]
    return " ".join([reached, *told])


def coefficient_tables(data: ReportData) -> Iterator[Table]:
    """Return a coefficient table for each model that has one."""
    for number_of, found in enumerate(data.coefficients):
        yield table(
            f"coefficients-{number_of + 1}",
            f"Coefficients of {found.model}",
            [
                "signal",
                "unit",
                "coefficient",
                "standard error, by drives",
                "t",
                "p",
                "standard error, by rows",
                "effect of one std",
                "variance inflation",
            ],
            [_coefficient(row) for row in found.rows],
            left=2,
            note=_evidence(found),
        )


def _coefficient(row: Coefficient) -> list[str]:
    return [
        row.name,
        row.unit.replace("^2", "²"),
        scientific(row.value, 3),
        scientific(row.cluster_error),
        number(row.t, 1),
        scientific(row.p, 0) if row.p >= 1e-99 else "< 10⁻⁹⁹",
        scientific(row.row_error),
        degrees(row.share_deg, 2, sign=True),
        number(row.inflation, 0),
    ]


def _evidence(found: Coefficients) -> str:
    return (
        f"{count(found.log_rows)} rows of {found.drives} drives. Rows at 100 Hz are not "
        "independent: the cluster-robust standard errors take each drive as one piece of evidence; "
        "those by rows, which are far too small, stand beside. Effect of one std: degrees of "
        "estimate for one standard deviation of the signal."
    )


def scenarios(data: ReportData) -> Table:
    """Return how the models and the filters do on every scenario."""
    evaluated = data.evaluated
    shown = {
        **{f"model {k}": v for k, v in evaluated.models.items() if k in SHOWN_MODELS},
        **{
            name.removesuffix("_tuned").replace("_", " "): name
            for name in evaluated.of_kind("filter")
            if name.endswith("_tuned")
        },
    }
    rows: list[list[str | Cell]] = []
    for name, scenario in evaluated.scenarios.items():
        found = [evaluated.figures(name, estimator) for estimator in shown.values()]
        least = min(
            (one.error_std_deg for one in found if one and one.error_std_deg and one.coverage == 1),
            default=None,
        )
        place = scenario["paper"]
        rows.append(
            [
                scenario["description"] + (f" ({place})" if place else ""),
                number(scenario["truth"]["sideslip_std_deg"], 2),
                *(_std(one, least) for one in found),
            ]
        )
    return table(
        "scenarios",
        "Every test drive: standard deviation of the error in degrees",
        ["test drive", "angle itself", *shown],
        rows,
        note=(
            "Green: the smallest of the row. A percentage: the share of the drive with an "
            "estimate, where a signal is missing; such are not compared. Filters and observers are "
            "the tuned ones; they know mass, geometry and tyres of the training car, the "
            "regression nothing but its drives."
        ),
    )


def _std(found: ErrorFigures | None, least: float | None = None) -> Cell:
    if found is None or found.error_std_deg is None:
        return Cell(number(None))
    text = number(found.error_std_deg)
    if found.coverage < 1:
        return Cell(f"{text} ({percent(found.coverage)})")
    return Cell(text, "good" if found.error_std_deg == least else "")


def rivals(data: ReportData) -> Table | None:
    """Return what the learned rivals reach and cost; None if they were not trained."""
    found = data.evaluated.rows("rivals")
    if not found:
        return None
    return table(
        "rivals",
        "Learned rivals: accuracy, and what they cost on board",
        [
            "learner",
            "signals",
            "cross-validated correlation",
            "error std",
            "nominal drive",
            "training, s",
            "bytes on board",
            "one estimate, µs",
        ],
        [
            [
                one["learner"],
                str(len(one["signals"])),
                number(one["cross_validated"]["correlation"], 4),
                degrees(one["cross_validated"]["error_std_deg"]),
                _std(data.evaluated.figures("nominal", one["name"])),
                number(one["training_s"], 2),
                count(one["size_bytes"]),
                number(one["one_estimate_us"], 1),
            ]
            for one in found
        ],
        note=f"Trained on {count(found[0]['rows'])} rows of the same training drives, same folds.",
    )


def fleets(data: ReportData) -> Iterator[Table]:
    """Return for each fleet-trained model its errors beside those of the one-car model."""
    rows = data.evaluated.rows("comparisons")
    for fleet in dict.fromkeys(row["fleet"].rpartition("/")[0] for row in rows):
        own = [row for row in rows if row["fleet"].rpartition("/")[0] == fleet]
        numbers = list(dict.fromkeys(row["model"] for row in own))
        by_key = {(row["scenario"], row["model"]): row for row in own}
        better = sum(row["better"] == row["fleet"] for row in own)
        yield table(
            f"fleet-{fleet.partition('@')[0]}",
            f"Root mean square error in degrees, trained as {data.evaluated.group} "
            f"\N{RIGHTWARDS ARROW} as {fleet}",
            ["test drive", *(f"model {number}" for number in numbers)],
            [
                [
                    data.evaluated.scenarios[name]["description"],
                    *(_pair(by_key.get((name, number))) for number in numbers),
                ]
                for name in dict.fromkeys(row["scenario"] for row in own)
            ],
            note=f"Green: {fleet} is better. That is so in {better} of {len(own)} cases.",
        )


def _pair(row: Mapping[str, Any] | None) -> Cell:
    if row is None:
        return Cell(number(None))
    text = f"{number(row['one_car_rmse_deg'])} \N{RIGHTWARDS ARROW} {number(row['fleet_rmse_deg'])}"
    return Cell(text, "good" if row["better"] == row["fleet"] else "")


def storage(data: ReportData) -> Table:
    """Return what the warehouse holds."""
    return table(
        "storage",
        "Rows and bytes",
        ["table", "version", "files", "drives", "rows", "size", "bytes a row"],
        [
            [
                one.name,
                number(one.version, 0) if one.version is not None else number(None),
                count(one.files),
                count(one.drives) if one.drives is not None else number(None),
                count(one.rows),
                size(one.size_bytes),
                number(one.size_bytes / one.rows, 1) if one.rows else number(None),
            ]
            for one in data.tables
        ],
        note=(
            f"A row of the logs is one sample at 100 Hz of {len(catalogue().signals)} signals, and "
            "what is known of the drive. Models are made from the Gram rows alone, one a drive."
        ),
    )
