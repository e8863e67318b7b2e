"""The command that does the whole job: simulate what is missing, gram, select, publish."""

import time
from dataclasses import asdict
from typing import Annotated, Any

import typer

from fleet_slip.catalogue.features import PLAIN
from fleet_slip.cli.data import Days, Through, chosen_days, run_gram, run_simulation
from fleet_slip.cli.models import registry_of
from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.publishing import print_publication, published
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.selecting import WorthOption, print_selection
from fleet_slip.cli.workers import Cluster, Threads, workers
from fleet_slip.errors import RefusedError
from fleet_slip.maintenance.marks import marked_models
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.publish import Publication, manifest_of, publish
from fleet_slip.runs.log import step
from fleet_slip.selection.compare import Selection
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.selection.request import (
    WORTH,
    RequestedSelection,
    SelectionRequest,
    answer_request,
    parse_worth,
)

DEFAULT_CAMPAIGN = "waterford"

RUN_MODELS = "estimator"
"""The model list that a run chooses from."""


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(run)


@record_run
def run(
    context: typer.Context,
    campaign: Annotated[
        str, typer.Option(help="A campaign of configs/campaigns, or the path of a TOML file.")
    ] = DEFAULT_CAMPAIGN,
    days: Days = None,
    through: Through = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the model. Default: the campaign's.")
    ] = None,
    models: Annotated[
        str, typer.Option(help="A model list of configs/models, or a TOML file.")
    ] = RUN_MODELS,
    worth: WorthOption = WORTH,
    threads: Threads = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

    It can be repeated at any time, and after any interruption: what is done is not done again. A
    second run of the campaign at the same time waits for the first. A nightly run appends the next
    day with --through today.
    """
    from fleet_slip.simulation.campaign import load_campaign  # noqa: PLC0415 - the simulator takes a while

    started = time.monotonic()
    plan = load_campaign(campaign)
    model_name = require_model_name(name or plan.name)
    lock = f".run-{plan.name}.lock"
    with context.obj.root.exclusive(lock, lambda: say(f"{plan.name}: waiting for another run")):
        with workers(context, cluster, threads) as (warehouse, executor):
            simulation = run_simulation(warehouse, plan, chosen_days(plan, days, through), executor)
            gram = run_gram(warehouse, executor)
            condition = f"campaign = '{plan.name}'"
            feature_set = load_model_list(models).features
            wide = None
            if feature_set != PLAIN:
                wide = run_gram(warehouse, executor, feature_set, condition)
        with step("select"):
            answer = answer_request(
                context.obj,
                SelectionRequest(cohort=condition, models=models, worth=parse_worth(worth)),
            )
        selection = answer.selection
        with step("publish"):
            publication, refusal = _publish(context, answer, model_name)
    changed = simulation.changed or gram.changed or bool(wide and wide.changed)
    changed = changed or (publication is not None and publication.new)
    summary = {
        "campaign": plan.name,
        "changed": changed,
        "simulate": asdict(simulation),
        "gram": asdict(gram),
        **({"gram_features": asdict(wide)} if wide else {}),
        "select": selection.as_dict(),
        "publish": published(publication) if publication else {"new": False, "reason": refusal},
        "seconds": round(time.monotonic() - started, 3),
    }
    if json:
        print_json(summary)
    else:
        _print_summary(summary, selection, publication, refusal)


def _publish(
    context: typer.Context, answer: RequestedSelection, name: str
) -> tuple[Publication | None, str]:
    manifest = manifest_of(answer.selection, name, answer.label, answer.config_sha256)
    registry = registry_of(context.obj)
    champion = registry.champion(name)
    # What was trained on forgotten drives is replaced, even if the new model is worse.
    tainted = champion and champion.reference in marked_models(context.obj.root)
    try:
        return publish(registry, manifest, answer.selection, force=bool(tainted)), ""
    except RefusedError as error:
        return None, str(error)


def _print_summary(
    summary: dict[str, Any],
    selection: Selection[Any],
    publication: Publication | None,
    refusal: str,
) -> None:
    simulated, gram = summary["simulate"], summary["gram"]
    seconds = summary["seconds"]
    if not summary["changed"]:
        kept = publication.version.reference if publication else refusal
        say(f"{summary['campaign']}: nothing to do, {kept} is up to date ({seconds:.1f} s)")
        return
    say(f"simulated {simulated['drives']} drives, {simulated['rows']:,} rows")
    say(f"gram: {gram['rows_read']:,} rows read, {gram['gram_rows']:,} Gram rows")
    if wide := summary.get("gram_features"):
        name = wide["feature_set"]
        say(f"gram {name}: {wide['rows_read']:,} rows read, {wide['gram_rows']:,} Gram rows")
    print_selection(selection)
    if publication:
        print_publication(publication)
    else:
        say(refusal)
    say(f"done in {seconds:.1f} s")
