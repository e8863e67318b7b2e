"""The command of every night with real cars."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.api.requests import NightRequest
from fleet_slip.cli.options import request_options
from fleet_slip.cli.output import Json, print_json, print_text, say
from fleet_slip.cli.progress_bar import progress_of_steps
from fleet_slip.cli.record_runs import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.extras import needed


@record_run
@request_options(NightRequest, name="--model")
def nightly(
    context: typer.Context,
    request: NightRequest,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write the summary there: NIGHT.txt, NIGHT.json, NIGHT.html. It names drives; "
            "forget does not reach it.",
            show_default=False,
        ),
    ] = None,
    threads: Threads = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Do all of a night with real cars: ingest what is new, examine it, train again, verify.

    Drives with faulty sensors train no model. The winner becomes champion if it is not worse, else
    a candidate. Killed at any moment and given again, it ends where it would have ended. Exits with
    10 if something calls for attention, else with the code of the first step that failed.

    Example: **fleet-slip nightly --landing /srv/logs --mapping logger.toml --model fleet**
    """
    fleet: Fleet = context.obj
    with (
        open_workers(fleet.root, cluster or threads) as executor,
        progress_of_steps("rows", executor) as show,
    ):
        options = {
            **vars(request),
            "workers": executor,
            "progress": show,
            "waiting": lambda: say(f"{request.name}: waiting for another night"),
        }
        report = fleet.nightly(**options)
    if output is not None:
        with needed("report", "a summary in files"):
            from fleet_slip.monitoring.night_page import write_summary  # noqa: PLC0415 - draws

        write_summary(report, output)
    if json:
        print_json(report)
    else:
        print_text(report.as_text())
    if problem := report.problem:
        problem.headline = f"the night of {report.night}: {report.verdict}"
        raise problem
