"""What `evaluate` prints of drives that nobody tuned to: blind ones, and measured ones left out."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fleet_slip.cli.accuracy.evaluation_tables import heading
from fleet_slip.cli.output import cell, print_table, print_text
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.comparison.evaluation.blind import BlindRow
    from fleet_slip.comparison.evaluation.scenario_runs import ErrorFigures


def print_blind(rows: Sequence["BlindRow"], everything: bool) -> None:
    """Print how far estimators are off on blind drives: published models and filters, or all."""
    errors = {name: one.rmse_deg for name, one in rows[0].figures.items()}
    names = [
        name
        for name, rmse_deg in errors.items()
        if "@" in name.rpartition("/")[2]
        or (rmse_deg is not None and (everything or "/" not in name))
    ]
    names.sort(key=lambda name: ("@" not in name, errors[name] is None, errors[name]))
    shown = names if everything else names[:BLIND_NAMES]
    print_table(
        "Blind drives: RMSE in deg against the exact angle",
        ["drives", "m/s", "side-slip std", *map(heading, shown)],
        [
            [
                row.name.replace("_", " "),
                f"{row.speed_mps[0]:.0f} to {row.speed_mps[1]:.0f}",
                f"{row.sideslip_std_deg:.2f}",
                *(_blind_cell(row.figures[name]) for name in shown),
            ]
            for row in rows
            if everything or row.drives > 1
        ],
    )
    for name in names:
        if errors[name] is None:
            print_text(
                f"{name} has no estimate on any of them: it may need what a car's own drives tell, "
                "and nobody knows these cars."
            )
    if not everything:
        print_text("Every drive, and all estimators: --all; for machines --json.")


BLIND_NAMES = 5
"""Estimators of the table that is printed first: published models, then the best of the others."""


def _blind_cell(one: "ErrorFigures") -> str:
    if one.rmse_deg is None:
        return "none"
    return f"{one.rmse_deg:.3f}" + ("" if one.coverage == 1 else f" ({one.coverage:.0%})")


def print_own_car(content: Mapping[str, Any], everything: bool) -> None:
    """Print figures on measured drives, the best estimator first; with all of them by drive."""
    estimators = content["estimators"]
    print_table(
        f"{content['cohort']}: each quarter of the {content['parts_of']} left out in turn, "
        f"{number_of(len(content['drives']), 'drive')}",
        ["estimator", "knows", "RMSE deg", "mean", "std", "correlation", "rows"],
        [
            [
                name,
                one["told"],
                cell(one["rmse_deg"], ".3f"),
                cell(one["error_mean_deg"], "+.3f"),
                cell(one["error_std_deg"], ".3f"),
                cell(one["correlation"], ".3f"),
                f"{one['coverage']:.0%}",
            ]
            for name, one in estimators.items()
        ],
        left=2,
    )
    if content["vehicle"] is None:
        print_text(
            "No filter competes: no vehicle file is known. Make one: fleet-slip identify, and name "
            "it with --vehicle."
        )
    if everything:
        print_table(
            "RMSE in deg by drive",
            ["drive", *map(heading, estimators)],
            [
                [drive, *(cell(found[name], ".3f") for name in estimators)]
                for drive, found in content["drives"].items()
            ],
        )
