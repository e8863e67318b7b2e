"""The paper's own tables and targets, its values beside ours."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fleet_slip.comparison.evaluation.targets import FILTER_SCENARIOS, PAPER_TABLE_TWO
from fleet_slip.comparison.report.report_data import ReportData
from fleet_slip.pages.page_parts import Cell, ReportTable, count, degrees, number, table

PAPER_TABLE_ONE = {"1": 0.9013, "2": 0.9534, "3": 0.9796, "4": 0.9911, "5": 0.9911}
"""Cross-validated correlations, Table I."""


def table_one(data: ReportData) -> ReportTable:
    """Return Table I: cross-validated correlation of the five models."""
    folding = data.trained.selection.folds
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
            degrees(model.pooled.rmse_deg),
            *_by_speed(data, model.name),
        ]
        for model in data.trained.selection.models
    ]
    winner = data.trained.selection.winner.reason
    head = ["model", "signals", "paper", "ours", "standard error", "RMSE"]
    if data.by_speed:
        head += ["by speed", "RMSE by speed"]
    return table(
        "table-1",
        "Table I. Properties of the estimation models: cross-validated correlation",
        head,
        rows,
        left=2,
        note=(
            f"{folding.count} folds by {folding.by}, "
            f"{count(data.trained.selection.cohort.rows)} rows. {winner}"
            + _label_noise(data)
            + (BY_SPEED if data.by_speed else "")
        ),
    )


BY_SPEED = (
    " By speed: whole bands of the drives' speed are left out one after another, so that no model "
    "has seen the speeds it is tested at. Folds by drive interpolate between neighbours."
)


def _label_noise(data: ReportData) -> str:
    noise = data.version.manifest.cross_validation.label_noise_deg
    if noise is None:
        return " How noisy the label is, is not known: every RMSE here has its noise in it."
    return f" Every RMSE here has the label's own noise in it, {degrees(noise, 4)}."


def _by_speed(data: ReportData, name: str) -> list[str]:
    if not data.by_speed:
        return []
    found = data.by_speed.get(name)
    if found is None:
        return [number(None), number(None)]
    return [number(found.correlation, 4), degrees(found.pooled.rmse_deg)]


def distances(data: ReportData) -> ReportTable | None:
    """Return the distance D of equation (2) of each nested model; None if it cannot be told."""
    found = data.distances
    if isinstance(found, str):
        return None
    evidence = found.evidence
    expected = evidence.distances()
    least = min(range(len(expected)), key=lambda j: expected[j])
    return table(
        "distances",
        "Distance D of equation (2) of the nested models, all signals in their declared order",
        ["signals", "added", "contribution A", "D from the full model", "expected D from the true"],
        [
            [
                str(j),
                found.order[j - 1] if j else "none",
                number(evidence.contributions[j - 1] if j else None, 1),
                number(to_full, 1),
                Cell(number(expected[j], 1), "good" if j == least else ""),
            ]
            for j, to_full in enumerate(evidence.excess())
        ],
        left=2,
        note=(
            f"In units of the noise, taking {evidence.kind} for independent: the rows are worth "
            f"{count(round(evidence.rows))}. A is what a signal adds; without any effect it is 1 "
            "on average. Green: the smallest expected distance, which is the smallest C_p. Without "
            f"any signal the RMSE is {degrees(found.null.pooled.rmse_deg)}."
        ),
    )


def table_two(data: ReportData) -> ReportTable:
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


def targets(data: ReportData) -> Iterator[ReportTable]:
    """Return the requirements on the models of Table I, and those against the Kalman filter."""
    checks = data.evaluated.rows("checks")
    models = list(data.evaluated.models.values())
    paper = [one for one in checks if one["scenario"] not in FILTER_SCENARIOS[1:]]
    plain = [one for one in paper if "below that of" not in one["requirement"]]
    against = [one for one in checks if "below that of" in one["requirement"]]
    if plain:
        found = {
            (one["requirement"], one["estimator"]): Cell(
                number(one["found"], 4), "good" if one["reached"] else "miss"
            )
            for one in plain
        }
        yield table(
            "targets",
            "What the paper's scenarios ask for, by model of Table I",
            ["requirement", *(f"model {name}" for name in data.evaluated.models)],
            [
                [
                    requirement.replace("_", " "),
                    *(found.get((requirement, name), Cell(number(None))) for name in models),
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


def _misses(checks: Sequence[Mapping[str, Any]]) -> str:
    missed = [one for one in checks if not one["reached"]]
    reached = f"{len(checks) - len(missed)} of {len(checks)} reached."
    told = [
        f"Missed by {one['estimator']} ({one['requirement']}): {one['explanation']}"
        for one in missed
    ]
    return " ".join([reached, *told])
