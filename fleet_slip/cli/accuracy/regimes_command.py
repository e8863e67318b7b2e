"""The command that shows a model's error by regime: regimes."""

import math

import typer

from fleet_slip.api.requests import RegimesRequest
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort, request_options
from fleet_slip.cli.output import Json, print_json, print_line, print_table
from fleet_slip.selection.regimes import RegimeComparison
from fleet_slip.words import number_of


@request_options(RegimesRequest, argument="model")
def regimes(
    context: typer.Context,
    request: RegimesRequest,
    cohort: Cohort = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Show a model's error by speed and lateral acceleration, and whether to split it there.

    One model for all rows is cross-validated against one for each regime. Needs Gram rows by
    regime: **fleet-slip gram --features regimes**

    Example: **fleet-slip regimes --over speed**
    """
    result: RegimeComparison = context.obj.cohort(cohort).regimes(**vars(request))
    if json:
        print_json({"cohort": cohort, **result.as_dict()})
    else:
        _print_regimes(result, request.by)


def _print_regimes(result: RegimeComparison, by: str) -> None:
    print_table(
        f"{number_of(result.drives, 'drive')}, {number_of(result.folds, 'fold')} by {by}: "
        f"{' '.join(result.signals)}",
        ["regime", "rows", "share", "pooled RMSE deg", "std", "split RMSE deg", "std", ""],
        [
            [
                one.name,
                f"{one.rows:,}",
                f"{one.share:.1%}",
                f"{one.pooled.rmse_deg:.4f}",
                f"{one.pooled.error_std_deg:.4f}",
                f"{one.split.rmse_deg:.4f}",
                f"{one.split.error_std_deg:.4f}",
                "" if one.own else "too few rows",
            ]
            for one in result.regimes
        ],
    )
    one, own = result.pooled, result.split
    better = "a model for each regime" if result.split_wins else "one model for all"
    print_line(
        f"one model: correlation {one.correlation:.4f}, RMSE {one.rmse_deg:.4f} deg; one for each "
        f"regime: {own.correlation:.4f}, {own.rmse_deg:.4f} deg. Over the folds, splitting adds "
        f"{result.gain:+.4f} +- {result.gain_standard_error:.4f} to the correlation and takes "
        f"{math.degrees(result.rmse_gain):.4f} +- "
        f"{math.degrees(result.rmse_gain_standard_error):.4f} deg from the RMSE; worth having is "
        f"{result.worth}. Choose {better}."
    )
