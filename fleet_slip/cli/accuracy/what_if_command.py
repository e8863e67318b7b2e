"""The command that predicts a model's error with worse sensors: what-if."""

import typer

from fleet_slip.api.requests import WhatIfRequest
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort, request_options
from fleet_slip.cli.output import Json, figures_cells, print_json, print_table
from fleet_slip.regression.inference.standard_errors import INTERCEPT
from fleet_slip.selection.what_if import WhatIf
from fleet_slip.words import number_of


@request_options(WhatIfRequest, argument="model")
def what_if(
    context: typer.Context,
    request: WhatIfRequest,
    cohort: Cohort = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Predict a model's error with worse sensors, in closed form; nothing is simulated.

    Bias and noise come on top of what the logs have. Shown too: the best model for such sensors.

    Example: **fleet-slip what-if waterford --noise ay=0.2 --bias yaw_rate=0.02**
    """
    result: WhatIf = context.obj.cohort(cohort).what_if(**vars(request))
    if json:
        added = {"noise": request.noise, "bias": request.bias}
        print_json({"cohort": cohort, **added, **result.as_dict()})
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
