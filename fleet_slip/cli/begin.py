"""The command that does the whole job: simulate what is missing, gram, select, publish."""

import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.api.training import LearnReport, RunReport
from fleet_slip.base import pluralize
from fleet_slip.cli.options import command
from fleet_slip.cli.output import All, Json, print_json, print_parts, say
from fleet_slip.errors import FleetSlipError
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.publish import DryRun, Publication, recipe_for
from fleet_slip.models.request import SelectionRequest
from fleet_slip.storage.data_root import data_root
from fleet_slip.storage.runs import step

# The command that publishes the model that a selection chose.


@command(
    Fleet.publish,
    Fleet.cohort,
    FleetCohort.select,
    arguments=["name"],
    without=["predicate"],
)
def publish(
    fleet: Fleet,
    name: str,
    force: bool,
    candidate: bool,
    include_faulty: bool,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="SQL predicate on the view drives. Default: that of the model's champion; all "
            "drives, of a new model."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be published, and publish nothing.")
    ] = False,
    mlflow: Annotated[
        str | None, typer.Option(help="Also register the version in the MLflow server of this URI.")
    ] = None,
    everything: All = False,
    json: Json = False,
    **asked: Any,
) -> None:
    """Select on a cohort and make the winner the next version of a model, and its champion.

    The options are those of select. A model that is there is trained again as its champion was, but
    for what is asked for.

    Try it first: fleet-slip publish waterford --dry-run

    Example: fleet-slip publish wet --cohort "adhesion < 0.8"
    """
    require_model_name(name)
    recipe = recipe_for(fleet.registry(), name, SelectionRequest(**asked), cohort)
    if recipe.told:
        say(f"{name}: {recipe.told}")
    drives = fleet.cohort(recipe.cohort, include_faulty=include_faulty)
    with step("select"):
        selection = drives.select(**vars(recipe.request))
    come_to = fleet.would_publish if dry_run else fleet.publish
    answer: DryRun | Publication = come_to(name, selection, force=force, candidate=candidate)
    if json:
        if selection.examined:
            say(selection.examined)
        print_json(answer)
    else:
        print_parts(selection.parts(everything))
        print_parts(answer.parts())
    if mlflow and isinstance(answer, Publication):
        number = fleet.log_to_mlflow(answer.version, mlflow)
        if not json:
            say(f"in MLflow: {name}, version {number}")
    if answer.problem:
        raise answer.problem


@command(Fleet.run, progress="")
def run(report: RunReport, fleet: Fleet, everything: All = False, json: Json = False) -> None:
    """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

    It can be repeated at any time, and after any interruption: what is done is not done again. A
    second run of the campaign at the same time waits for the first. A nightly run appends the next
    day with --through today.

    Example: fleet-slip run --campaign smoke
    """
    if json:
        return print_json(report)
    print_parts(report.parts(everything))
    if (made := report.publication) and made.new:
        model = made.version.manifest.name
        _say_of_lost(fleet, report.campaign, model)
        if made.version.version == 1:
            say("next:")
            for line in next_steps(fleet, report.campaign, model):
                say(f"  {line}")


@command(Fleet.learn, arguments=["name", "logs"], progress="")
def learn(report: LearnReport, fleet: Fleet, everything: All = False) -> None:
    """Make a model of measured logs: ingest, gram, select, publish. Repeat it when logs are added.

    It trains on the side-slip angle of the mapping, else on the course over ground. At its end it
    says what it assumed, and what to type next. Draft the mapping with: fleet-slip mapping suggest

    Example: fleet-slip learn golf logs/ --mapping golf.toml
    """
    print_parts(report.parts(everything))
    if report.changed and report.publication:
        begin, name = f"{program()}{_root_option(fleet)}", report.model
        cohort = f"campaign = '{report.mapping}'"
        say("next:")
        say(f"  {begin} show {name}")
        say(f"  {begin} export {name} --to c --output {name}")
        if not report.publication.version.manifest.learned_from:
            say(f'  {begin} evaluate {name} --cohort "{cohort}"')


def next_steps(fleet: Fleet, campaign: str, model: str) -> list[str]:
    """Return command lines to go on with: a query, the model, a cohort, the test drives."""
    begin = f"{program()}{_root_option(fleet)}"
    query = "SELECT drive_id, max(abs(degrees(sideslip_rad))) AS beta_deg FROM log GROUP BY ALL"
    lines = [f'{begin} sql "{query}"', f"{begin} show {model}"]
    if cohort := _faster_half(fleet, campaign):
        lines.append(f'{begin} select --cohort "{cohort}"')
    lines.append(f"{begin} evaluate {model} && {begin} report {model}")
    return lines


def _say_of_lost(fleet: Fleet, campaign: str, model: str) -> None:
    """Say in how many drives the car was lost: the model learned from them, too."""
    query = "SELECT campaign, count(lost_control_s), count(*) FROM drives GROUP BY ALL"
    counted = {name: (lost, drives) for name, lost, drives in fleet.sql(query).fetchall()}
    lost, drives = counted.get(campaign, (0, 0))
    if lost:
        cohort = f"campaign = '{campaign}' AND lost_control_s IS NULL"
        say(
            f"in {lost:,} of {pluralize(drives, 'drive')} the car lost control; the model was "
            "trained on these, too. Without them:"
        )
        say(f'  {program()}{_root_option(fleet)} publish {model} --cohort "{cohort}"')


def program() -> str:
    """Return how this program is called from here: by name where that finds it, else by path."""
    called = Path(sys.argv[0])
    found = shutil.which(called.name)
    if found and os.path.realpath(found) == os.path.realpath(called):
        return called.name
    here = Path.cwd()
    path = called.absolute()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))


def _root_option(fleet: Fleet) -> str:
    """Return the option that names the data root, unless it is the usual one."""
    try:
        usual = str(data_root())
    except FleetSlipError:
        usual = ""
    return "" if str(fleet.root) == usual else f" --root {shlex.quote(str(fleet.root))}"


def _faster_half(fleet: Fleet, campaign: str) -> str | None:
    """Return a predicate that about half of the campaign's drives satisfy; None if none is told."""
    medians = fleet.sql("SELECT campaign, median(speed_factor) FROM drives GROUP BY ALL").fetchall()
    speed = dict(medians).get(campaign)
    return None if speed is None else f"speed_factor > {speed:.2f}"


@command(Fleet.cohort, FleetCohort.select)
def select(everything: All = False) -> None:
    """Compare models on a cohort by cross-validation and choose one. Reads Gram rows only.

    Compare a list of models: fleet-slip select --models table1

    Find an order and a place to stop: fleet-slip select --ranking backward --criterion bic

    Choose among many columns: fleet-slip select --features windows --search exchange

    Search all subsets: fleet-slip select --all-subsets --criterion cv
    """
