"""The command that predicts a model's error with worse sensors: what-if."""

from typing import Annotated

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort, FeatureSetOption, Model, Signals, quantities
from fleet_slip.cli.output import Json, figures_cells, print_json, print_table
from fleet_slip.regression.inference.standard_errors import INTERCEPT
from fleet_slip.selection.what_if import WhatIf
from fleet_slip.words import number_of


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
    result: WhatIf = context.obj.cohort(cohort).what_if(
        model, noise=noises, bias=biases, signals=signals, features=feature_set
    )
    if json:
        print_json({"cohort": cohort, "noise": noises, "bias": biases, **result.as_dict()})
    else:
        _print_what_if(result)


def _print_what_if(result: WhatIf) -> None:
    print_table(
        f"{number_of(result.drives, 'drive')}, {number_of(result.before.rows, 'row')}",
        ["", "correlation", "RMSE deg", "mean deg", "std deg"],
        [
            ["as logged", *figures_cells(result.before)],
            ["with these sensors", *figures_cells(result.after)],
            ["best model for these sensors", *figures_cells(result.refitted_after)],
        ],
    )
    print_table(
        "\nbest model for these sensors",
        ["signal", "coefficient"],
        [[INTERCEPT, f"{result.refitted.offset:.6g}"]]
        + [[name, f"{weight:.6g}"] for name, weight in result.refitted.weights.items()],
    )
