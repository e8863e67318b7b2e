"""The command that compares least squares with what shrinks coefficients: shrink."""

import typer

from fleet_slip.api.requests import ShrinkRequest
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort, request_options
from fleet_slip.cli.output import Json, cell, figures_cells, print_json, print_table
from fleet_slip.selection.shrinkage import Shrunk
from fleet_slip.words import number_of


@request_options(ShrinkRequest)
def shrink(
    context: typer.Context,
    request: ShrinkRequest,
    cohort: Cohort = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Compare least squares with ridge, lasso, James-Stein and Pace regression.

    Penalties are chosen by cross-validation inside each training fold. With many drives for each
    signal there is little to shrink; with few drives, or many features, it shows here.

    Example: **fleet-slip shrink --signals ay,yaw_rate**
    """
    found: tuple[Shrunk, ...] = context.obj.cohort(cohort).shrink(**vars(request))
    inputs = found[0].cross_validation.signals  # least squares keeps all
    if json:
        print_json({"cohort": cohort, "methods": found})
        return
    first = found[0].cross_validation
    print_table(
        f"{number_of(first.drives, 'drive')}, {number_of(len(first.folds), 'fold')} by "
        f"{request.by}",
        ["method", "signals kept", "penalty", "correlation", "RMSE deg", "mean deg", "std deg"],
        [
            [
                one.cross_validation.name,
                f"{len(one.cross_validation.signals)} of {len(inputs)}",
                cell(one.penalty, ".2g"),
                *figures_cells(one.cross_validation.pooled),
            ]
            for one in found
        ],
    )
