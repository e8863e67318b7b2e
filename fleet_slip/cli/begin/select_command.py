"""The command that compares models on a cohort."""

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort, Unexamined, request_options
from fleet_slip.cli.output import All, Json, print_json
from fleet_slip.selection.request import SelectionRequest


@request_options(SelectionRequest)
def select(
    context: typer.Context,
    request: SelectionRequest,
    cohort: Cohort = TRAINING_DRIVES,
    unexamined: Unexamined = False,
    everything: All = False,
    json: Json = False,
) -> None:
    """Compare models on a cohort by cross-validation and choose one. Reads Gram rows only.

    Compare a list of models: **fleet-slip select --models table1**

    Find an order and a place to stop: **fleet-slip select --rank backward --criterion bic**

    Choose among many columns: **fleet-slip select --features windows --search exchange --most 12**

    Search all subsets: **fleet-slip select --all-subsets --criterion cv --bootstrap 1000**
    """
    from fleet_slip.cli.begin.selection_tables import print_selection  # noqa: PLC0415 - takes a while
    from fleet_slip.cli.left_out import say_examined  # noqa: PLC0415 - takes a while

    selection = context.obj.cohort(cohort, unexamined=unexamined).select(**vars(request))
    say_examined(selection.examined)
    if json:
        print_json(selection)
    else:
        print_selection(selection, everything)
