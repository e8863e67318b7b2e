"""The command that publishes the model that a selection chose."""

from typing import Annotated

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.begin.select_command import print_selection
from fleet_slip.cli.completing import complete_model
from fleet_slip.cli.models.signing_commands import SignKey, signing_key
from fleet_slip.cli.options import RESAMPLING, Cohort, selection_options
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.recorded import record_run
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.publish import Publication
from fleet_slip.runs.log import step
from fleet_slip.selection.answer_request import answer_request
from fleet_slip.selection.request import SelectionRequest


@record_run
@selection_options(without=RESAMPLING)
def publish(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(help="Name of the model, such as sideslip.", autocompletion=complete_model),
    ],
    request: SelectionRequest,
    cohort: Cohort = TRAINING_DRIVES,
    force: Annotated[
        bool, typer.Option("--force", help="Publish even what is worse than the champion.")
    ] = False,
    candidate: Annotated[
        bool,
        typer.Option(
            "--candidate", help="Publish as a candidate, which becomes champion by promote."
        ),
    ] = False,
    sign_key: SignKey = None,
    mlflow: Annotated[
        str | None, typer.Option(help="Also register the version in the MLflow server of this URI.")
    ] = None,
    json: Json = False,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion.

    The options are those of select.

    Example: **fleet-slip publish wet --cohort "adhesion < 0.8"**
    """
    require_model_name(name)
    with step("select"):
        selection = answer_request(context.obj.warehouse, request, cohort)
    publication = context.obj.publish(
        name, selection, force=force, candidate=candidate, sign_key=signing_key(sign_key)
    )
    number = context.obj.log_to_mlflow(publication.version, mlflow) if mlflow else None
    if json:
        print_json(publication)
    else:
        print_selection(selection)
        print_publication(publication)
        if number:
            say(f"in MLflow: {publication.version.manifest.name}, version {number}")


def print_publication(publication: Publication) -> None:
    """Say what was published."""
    done = "published" if publication.new else "nothing to publish:"
    say(f"{done} {publication.version.reference}. {publication.reason}")
