"""The command that does the whole job: simulate what is missing, gram, select, publish."""

import os
import shlex
import shutil
import sys
from pathlib import Path

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.api.requests import RunRequest
from fleet_slip.api.run_report import RunReport
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.cli.begin.publish_command import print_publication
from fleet_slip.cli.begin.selection_tables import print_selection
from fleet_slip.cli.options import request_options
from fleet_slip.cli.output import All, Json, print_json, say
from fleet_slip.cli.progress_bar import progress_of_steps
from fleet_slip.cli.record_runs import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.errors import FleetSlipError
from fleet_slip.files.data_root import data_root
from fleet_slip.words import number_of


@record_run
@request_options(RunRequest)
def run(
    context: typer.Context,
    request: RunRequest,
    threads: Threads = None,
    cluster: Cluster = None,
    everything: All = False,
    json: Json = False,
) -> None:
    """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

    It can be repeated at any time, and after any interruption: what is done is not done again. A
    second run of the campaign at the same time waits for the first. A nightly run appends the next
    day with --through today.

    Example: **fleet-slip run --campaign smoke**
    """
    from fleet_slip.simulation.campaign import load_campaign  # noqa: PLC0415 - the simulator takes a while

    fleet: Fleet = context.obj
    plan = load_campaign(str(request.campaign))
    doing = {"simulate": f"simulate {plan.name}", "gram": f"gram {PLAIN}"}

    def tell(name: str, done: int, total: int) -> None:
        show(doing.get(name, name), done, total)

    with (
        open_workers(fleet.root, cluster or threads) as executor,
        progress_of_steps("rows", executor) as show,
    ):
        options = {
            **vars(request),
            "campaign": plan,
            "workers": executor,
            "progress": tell,
            "waiting": lambda: say(f"{plan.name}: waiting for another run"),
        }
        report = fleet.run(**options)
    if json:
        print_json(report)
    else:
        _print_report(report, everything)
        if not ((made := report.publication) and made.new):
            return
        model = made.version.reference.partition("@")[0]
        _say_of_lost(fleet, plan.name, model)
        if made.version.version == 1:
            say("next:")
            for line in next_steps(fleet, plan.name, model):
                say(f"  {line}")


def _print_report(report: RunReport, everything: bool) -> None:
    simulated, gram, publication = report.simulation, report.gram, report.publication
    if not report.changed:
        kept = publication.version.reference if publication else report.refusal
        say(f"{report.campaign}: nothing to do, {kept} is up to date ({report.seconds:.1f} s)")
        return
    say(f"simulated {number_of(simulated.drives, 'drive')}, {number_of(simulated.rows, 'row')}")
    say(f"gram: {number_of(gram.rows_read, 'row')} read, {number_of(gram.gram_rows, 'Gram row')}")
    if wide := report.gram_features:
        say(
            f"gram {wide.feature_set}: {number_of(wide.rows_read, 'row')} read, "
            f"{number_of(wide.gram_rows, 'Gram row')}"
        )
    if report.selection:
        print_selection(report.selection, everything)
    if publication:
        print_publication(publication)
    else:
        say(report.refusal)
    say(f"done in {report.seconds:.1f} s")


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
            f"in {lost:,} of {number_of(drives, 'drive')} the car was lost, and the model learned "
            "from them, too. Without them:"
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
    """Return a condition that about half of the campaign's drives satisfy; None if none is told."""
    medians = fleet.sql("SELECT campaign, median(speed_factor) FROM drives GROUP BY ALL").fetchall()
    speed = dict(medians).get(campaign)
    return None if speed is None else f"speed_factor > {speed:.2f}"
