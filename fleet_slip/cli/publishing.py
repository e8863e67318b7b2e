"""The command that publishes the model that a selection chose."""

from typing import Annotated, Any

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.models import registry_of
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.selecting import (
    AllSubsets,
    Cohort,
    Criterion,
    Features,
    FoldBy,
    FoldCount,
    Models,
    Most,
    Naive,
    Nested,
    Rank,
    SearchMethod,
    WorthOption,
    print_selection,
)
from fleet_slip.cli.signing import SignKey
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.publish import Publication, manifest_of
from fleet_slip.models.publish import publish as publish_selection
from fleet_slip.runs.log import step
from fleet_slip.selection.request import WORTH, SelectionRequest, answer_request, parse_worth


def register(app: typer.Typer) -> None:
    """Add the command of this module."""
    app.command()(publish)


@record_run
def publish(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the model, such as sideslip.")],
    cohort: Cohort = TRAINING_DRIVES,
    models: Models = None,
    nested: Nested = None,
    features: Features = None,
    by: FoldBy = None,
    folds: FoldCount = None,
    rank: Rank = None,
    criterion: Criterion = None,
    worth: WorthOption = WORTH,
    all_subsets: AllSubsets = False,
    naive: Naive = False,
    search: SearchMethod = None,
    most: Most = None,
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
    json: Json = False,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion.

    The options are those of select.
    """
    require_model_name(name)
    request = SelectionRequest(
        cohort=cohort,
        models=models,
        nested=nested,
        features=features,
        by=by,
        folds=folds,
        rank=rank,
        criterion=criterion,
        worth=parse_worth(worth),
        all_subsets=all_subsets,
        naive=naive,
        search=search,
        most=most,
    )
    with step("select"):
        answer = answer_request(context.obj, request)
    selection = answer.selection
    manifest = manifest_of(selection, name, answer.label, answer.config_sha256)
    registry = registry_of(context.obj, sign_key)
    publication = publish_selection(registry, manifest, selection, force=force, candidate=candidate)
    if json:
        print_json(published(publication))
    else:
        print_selection(selection)
        print_publication(publication)


def published(publication: Publication) -> dict[str, Any]:
    """Return what `publish --json` prints."""
    version = publication.version
    return {
        "model": version.manifest.name,
        "version": version.version,
        "new": publication.new,
        "candidate": publication.candidate,
        "reason": publication.reason,
        "sha256": version.sha256,
    }


def print_publication(publication: Publication) -> None:
    """Say what was published."""
    done = "published" if publication.new else "nothing to publish:"
    say(f"{done} {publication.version.reference}. {publication.reason}")
