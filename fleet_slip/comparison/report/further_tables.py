"""Tables of what the evaluation found beyond the paper, of coefficients and of storage."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.comparison.evaluation.ranking import LEAST_COVERAGE
from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures
from fleet_slip.comparison.report.report_data import ReportData
from fleet_slip.comparison.report.training_findings import Coefficient
from fleet_slip.pages.page_parts import (
    Cell,
    ReportTable,
    count,
    degrees,
    number,
    percent,
    scientific,
    size,
    table,
)
from fleet_slip.words import number_of

SHOWN_MODELS = ("1", "2", "4", "5")
"""Model 3 hardly differs from model 2 anywhere."""


def coefficient_tables(data: ReportData) -> Iterator[ReportTable]:
    """Return a coefficient table for each model that has one."""
    for place, found in enumerate(data.coefficients):
        yield table(
            f"coefficients-{place + 1}",
            f"Coefficients of {found.model}",
            [
                "signal",
                "unit",
                "coefficient",
                f"standard error, by {found.cluster}s",
                "t",
                "p",
                "standard error, by rows",
                "effect of one std",
                "variance inflation",
            ],
            [_coefficient(row) for row in found.rows],
            left=2,
            note=(
                f"{count(found.log_rows)} rows of {number_of(found.drives, 'drive')}. Rows at "
                "100 Hz are not independent: the cluster-robust standard errors take each "
                f"{found.cluster} as one piece of evidence; those by rows, which are far too "
                "small, stand beside. Effect of one std: degrees of estimate for one standard "
                "deviation of the signal."
            ),
        )


def _coefficient(row: Coefficient) -> list[str]:
    one = row.estimate
    return [
        one.name,
        row.unit.replace("^2", "²"),
        scientific(one.value, 3),
        scientific(one.standard_error),
        number(one.t, 1),
        scientific(one.p, 0) if one.p >= 1e-99 else "< 10⁻⁹⁹",
        scientific(row.row_error),
        degrees(row.share_deg, 2, sign=True),
        number(row.inflation, 0),
    ]


def scenarios(data: ReportData) -> ReportTable:
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


def compared(data: ReportData) -> list[str]:
    """Return the estimators that stand beside each other: of Table I the paper's choice alone."""
    left_out = set(data.evaluated.models.values()) - {data.choice}
    return [name for name in data.evaluated.estimators if name not in left_out]


def standings(data: ReportData) -> ReportTable:
    """Return the RMSE of every estimator on every test drive, the smallest marked."""
    evaluated, names = data.evaluated, compared(data)
    rows: list[list[str | Cell]] = [
        [scenario, *_standing([evaluated.figures(scenario, name) for name in names])]
        for scenario in evaluated.scenarios
    ]
    return table(
        "standings",
        "Every estimator on every test drive: root mean square error in degrees",
        ["test drive", *names],
        rows,
        note=f"Green: the smallest of the row. {won(data)}A percentage: the share of the drive "
        "with an estimate; such do not compete.",
    )


def _standing(found: Sequence[ErrorFigures | None]) -> list[Cell]:
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


BOUNDS = tomllib.loads((files(__package__) / "bounds.toml").read_text(encoding="utf-8"))
"""Of test drives that ship: by how much who knows no car, and who is told it, must err, deg."""


def limits(data: ReportData) -> Iterator[ReportTable]:
    """Yield how many times the bound estimators err, where the bound of a drive is known."""
    evaluated = data.evaluated
    names = [name for name in compared(data) if name not in evaluated.of_kind("rival")]
    known = [one for one in evaluated.scenarios if one in BOUNDS]
    rows: list[list[str | Cell]] = []
    for drive in known:
        unknown, told = BOUNDS[drive]["unknown"], BOUNDS[drive]["told"]
        errors = [evaluated.figures(drive, name) for name in names]
        times = [
            number(one.rmse_deg / unknown if one and one.rmse_deg is not None else None, 1)
            for one in errors
        ]
        rows.append([drive, number(unknown, 4), number(told, 4), *times])
    if rows:
        yield table(
            "limits",
            "Distance to the limit: how many times the bound the root mean square error is",
            ["test drive", "bound, degrees", "told the car", *names],
            rows,
            note=(
                "The bound of Cramér and Rao for a filter that knows the laws of the extended one, "
                "but biases, mass, tyres and road by a prior alone. Below 1: what was learned of "
                "this very car."
            ),
        )


def won(data: ReportData) -> str:
    """Tell how many drives the published model wins; nothing in evaluations without a ranking."""
    found = data.evaluated.document.content.get("ranking")
    if found is None:
        return ""
    return (
        f"Among all without satellite navigation {found['estimator']} wins {found['won']} of "
        f"{found['drives']} drives, and comes within {found['close_ratio']} times the winner in "
        f"{found['close']} more; drives that differ in satellite navigation alone are one. "
    )


def _std(found: ErrorFigures | None, least: float | None = None) -> Cell:
    if found is None or found.error_std_deg is None:
        return Cell(number(None))
    text = number(found.error_std_deg)
    if found.coverage < 1:
        return Cell(f"{text} ({percent(found.coverage)})")
    return Cell(text, "good" if found.error_std_deg == least else "")


def rivals(data: ReportData) -> ReportTable | None:
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


def fleets(data: ReportData) -> Iterator[ReportTable]:
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


def storage(data: ReportData) -> ReportTable:
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
