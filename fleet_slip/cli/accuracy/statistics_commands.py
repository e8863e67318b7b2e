"""Commands that examine models on Gram rows: features, what-if, regimes, shrink."""

import math
from typing import Annotated

import typer

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.catalogue.feature_sets import PLAIN, FeatureSet
from fleet_slip.catalogue.features import features as known_features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.examined_options import FeatureSetOption, Model, Signals, quantities
from fleet_slip.cli.options import Cluster, Cohort, FoldCount, Naive, Worth
from fleet_slip.cli.output import Json, print_json, print_table, stdout
from fleet_slip.columns.column_sql import column_query
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.exact.figures import Figures
from fleet_slip.regression.inference.standard_errors import INTERCEPT
from fleet_slip.selection.regimes import RegimeComparison
from fleet_slip.selection.what_if import WhatIf
from fleet_slip.selection.worth import WORTH
from fleet_slip.words import number_of

By = Annotated[FoldKey, typer.Option(help="What a fold is made of.")]


def features(
    sets: Annotated[
        bool, typer.Option("--sets", help="List the feature sets instead of the features.")
    ] = False,
    sql: Annotated[
        str | None,
        typer.Option(
            "--sql",
            help="Print the query over log_counts that computes this feature, window or factor.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """List the features and feature sets of configs/features.toml.

    Features are integer functions of the logged counts, such as yaw rate over speed. Compute the
    Gram rows of a set with: **fleet-slip gram --features NAME**, then use it with: **fleet-slip
    select --features NAME**

    Example: **fleet-slip features --sql ay_mean_16**
    """
    known = known_features()
    if sql is not None:
        typer.echo(column_query(known, sql))
    elif json:
        print_json(
            {
                "windows": {
                    name: one.model_dump(mode="json") for name, one in known.time_columns.items()
                },
                "features": {
                    name: {**one.model_dump(mode="json"), "sql": one.sql}
                    for name, one in known.features.items()
                },
                "sets": {
                    name: {"identity": known.identity(name), **known.feature_set(name).model_dump()}
                    for name in (PLAIN, *known.sets)
                },
            }
        )
    elif sets:
        print_table(
            "",
            ["set", "columns", "rows of a drive", "description"],
            [
                [
                    name,
                    " ".join(known.feature_set(name).inputs),
                    _parts(known.feature_set(name)),
                    one.description,
                ]
                for name, one in ((n, known.feature_set(n)) for n in (PLAIN, *known.sets))
            ],
            left=4,
        )
    else:
        print_table(
            "",
            ["feature", "unit", "scale", "from", "description"],
            [
                [name, one.unit, str(one.scale), " ".join(one.inputs), one.description]
                for name, one in known.features.items()
            ],
            left=5,
        )
        print_table(
            "\ncolumns over time",
            ["column", "unit", "scale", "of", "description"],
            [
                [name, one.unit, str(one.scale), one.definition.of, one.description]
                for name, one in known.time_columns.items()
            ],
            left=5,
        )


def _parts(one: FeatureSet) -> str:
    if one.regimes:
        return f"by {' and '.join(one.regimes)}"
    if one.block_s:
        return f"in blocks of {one.block_s:f} s"
    if one.row_folds:
        return f"{number_of(one.row_folds, 'fold')} of rows"
    return "with the one before" if one.lagged else "together"


def what_if(
    context: typer.Context,
    model: Model = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            help="White noise that is added, as SIGNAL=STANDARD_DEVIATION in SI units, such as "
            "ay=0.2. May be repeated."
        ),
    ] = None,
    bias: Annotated[
        list[str] | None,
        typer.Option(help="Bias that is added, such as yaw_rate=0.02. May be repeated."),
    ] = None,
    signals: Signals = None,
    feature_set: FeatureSetOption = None,
    cohort: Cohort = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Predict a model's error with worse sensors, in closed form; nothing is simulated.

    Bias and noise come on top of what the logs have. Shown too: the best model for such sensors.

    Example: **fleet-slip what-if waterford --noise ay=0.2 --bias yaw_rate=0.02**
    """
    noises, biases = quantities(noise, "--noise"), quantities(bias, "--bias")
    result = _cohort(context, cohort).what_if(
        model, noise=noises, bias=biases, signals=signals, features=feature_set
    )
    if json:
        print_json({"cohort": cohort, "noise": noises, "bias": biases, **result.as_dict()})
    else:
        _print_what_if(result)


def _cohort(context: typer.Context, condition: str) -> FleetCohort:
    cohort: FleetCohort = context.obj.cohort(condition)
    return cohort


def _print_what_if(result: WhatIf) -> None:
    print_table(
        f"{number_of(result.drives, 'drive')}, {number_of(result.before.rows, 'row')}",
        ["", "correlation", "RMSE deg", "mean deg", "std deg"],
        [
            ["as logged", *_error(result.before)],
            ["with these sensors", *_error(result.after)],
            ["best model for these sensors", *_error(result.refitted_after)],
        ],
    )
    print_table(
        "\nbest model for these sensors",
        ["signal", "coefficient"],
        [[INTERCEPT, f"{result.refitted.offset:.6g}"]]
        + [[name, f"{weight:.6g}"] for name, weight in result.refitted.weights.items()],
    )


def _error(figures: Figures) -> list[str]:
    return [
        f"{figures.correlation:.4f}",
        f"{figures.rmse_deg:.4f}",
        f"{figures.error_mean_deg:+.4f}",
        f"{figures.error_std_deg:.4f}",
    ]


def regimes(
    context: typer.Context,
    signals: Signals = None,
    over: Annotated[
        str | None,
        typer.Option(
            help="Regimes to divide by, separated by commas, such as speed. Default: all of the "
            "set's."
        ),
    ] = None,
    cohort: Cohort = TRAINING_DRIVES,
    feature_set: Annotated[
        str, typer.Option("--features", help="Feature set that divides rows by regimes.")
    ] = "regimes",
    by: By = "drive",
    folds: FoldCount = None,
    worth: Worth = WORTH,
    json: Json = False,
) -> None:
    """Show a model's error by speed and lateral acceleration, and whether to split it there.

    One model for all rows is cross-validated against one for each regime. Needs Gram rows by
    regime: **fleet-slip gram --features regimes**

    Example: **fleet-slip regimes --over speed**
    """
    divided_by = [name.strip() for name in over.split(",")] if over else []
    result = _cohort(context, cohort).regimes(
        signals, over=divided_by, features=feature_set, by=by, folds=folds, worth=worth
    )
    if json:
        print_json({"cohort": cohort, **result.as_dict()})
    else:
        _print_regimes(result, by)


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
    stdout().print(
        f"one model: correlation {one.correlation:.4f}, RMSE {one.rmse_deg:.4f} deg; one for each "
        f"regime: {own.correlation:.4f}, {own.rmse_deg:.4f} deg. Over the folds, splitting adds "
        f"{result.gain:+.4f} +- {result.gain_standard_error:.4f} to the correlation and takes "
        f"{math.degrees(result.rmse_gain):.4f} +- "
        f"{math.degrees(result.rmse_gain_standard_error):.4f} deg from the RMSE; worth having is "
        f"{result.worth}. Choose {better}.",
        markup=False,
    )


def shrink(
    context: typer.Context,
    signals: Signals = None,
    feature_set: FeatureSetOption = None,
    cohort: Cohort = TRAINING_DRIVES,
    by: By = "drive",
    folds: FoldCount = None,
    naive: Naive = False,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Compare least squares with ridge, lasso, James-Stein and Pace regression.

    Penalties are chosen by cross-validation inside each training fold. With many drives for each
    signal there is little to shrink; with few drives, or many features, it shows here.

    Example: **fleet-slip shrink --signals ay,yaw_rate**
    """
    found = _cohort(context, cohort).shrink(
        signals, features=feature_set or PLAIN, by=by, folds=folds, naive=naive, cluster=cluster
    )
    inputs = found[0].cross_validation.signals  # least squares keeps all
    if json:
        print_json({"cohort": cohort, "methods": found})
        return
    first = found[0].cross_validation
    print_table(
        f"{number_of(first.drives, 'drive')}, {number_of(len(first.folds), 'fold')} by {by}",
        ["method", "signals kept", "penalty", "correlation", "RMSE deg", "mean deg", "std deg"],
        [
            [
                one.cross_validation.name,
                f"{len(one.cross_validation.signals)} of {len(inputs)}",
                "" if one.penalty is None else f"{one.penalty:.2g}",
                *_error(one.cross_validation.pooled),
            ]
            for one in found
        ],
    )
