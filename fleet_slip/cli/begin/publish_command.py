"""The command that publishes the model that a selection chose."""

from typing import Annotated

import typer

from fleet_slip.cli.begin.selection_tables import print_selection
from fleet_slip.cli.completing import complete_model
from fleet_slip.cli.left_out import say_examined
from fleet_slip.cli.options import RESAMPLING, Unexamined, request_options
from fleet_slip.cli.output import All, Json, print_json, say
from fleet_slip.cli.record_runs import record_run
from fleet_slip.errors import RefusedError
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.publish import DryRun, Publication
from fleet_slip.models.recipe import recipe_for
from fleet_slip.runs.log import step
from fleet_slip.selection.request import SelectionRequest


@record_run
@request_options(SelectionRequest, without=RESAMPLING)
def publish(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(help="Name of the model, such as sideslip.", autocompletion=complete_model),
    ],
    request: SelectionRequest,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="SQL condition on the view drives. Default: that of the model's champion; all "
            "drives, of a new model."
        ),
    ] = None,
    unexamined: Unexamined = False,
    force: Annotated[
        bool, typer.Option("--force", help="Publish even what is worse than the champion.")
    ] = False,
    candidate: Annotated[
        bool,
        typer.Option(
            "--candidate", help="Publish as a candidate, which becomes champion by promote."
        ),
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be published, and publish nothing.")
    ] = False,
    mlflow: Annotated[
        str | None, typer.Option(help="Also register the version in the MLflow server of this URI.")
    ] = None,
    everything: All = False,
    json: Json = False,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion.

    The options are those of select. A model that is there is trained again as its champion was, but
    for what is asked for.

    Try it first: **fleet-slip publish waterford --dry-run**

    Example: **fleet-slip publish wet --cohort "adhesion < 0.8"**
    """
    require_model_name(name)
    recipe = recipe_for(context.obj.registry(), name, request, cohort)
    if recipe.told:
        say(f"{name}: {recipe.told}")
    drives = context.obj.cohort(recipe.cohort, unexamined=unexamined)
    with step("select"):
        selection = drives.select(**vars(recipe.request))
    say_examined(selection.examined)
    if dry_run:
        told = context.obj.would_publish(name, selection, force=force, candidate=candidate)
        if json:
            print_json(told)
        else:
            print_selection(selection, everything)
        if told.refused:
            raise RefusedError(told.reason)
        if not json:
            _print_dry_run(told)
        return
    publication = context.obj.publish(name, selection, force=force, candidate=candidate)
    number = context.obj.log_to_mlflow(publication.version, mlflow) if mlflow else None
    if json:
        print_json(publication)
    else:
        print_selection(selection, everything)
        print_publication(publication)
        if number:
            say(f"in MLflow: {publication.version.manifest.name}, version {number}")


def _print_dry_run(told: DryRun) -> None:
    would = "would be published" if told.publishes else "would not be published"
    would += " as a candidate" if told.publishes and told.candidate else ""
    say(f"{told.model} {would}. {told.reason}")


def print_publication(publication: Publication) -> None:
    """Say what was published."""
    done = "published" if publication.new else "nothing to publish:"
    say(f"{done} {publication.version.reference}. {publication.reason}")
