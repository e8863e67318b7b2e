"""The command of every night with real cars."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.completing import complete_config, complete_model
from fleet_slip.cli.dates import date_of
from fleet_slip.cli.models.signing_commands import SignKey, signing_key
from fleet_slip.cli.options import Models, Worth
from fleet_slip.cli.output import Json, print_json, print_text, say
from fleet_slip.cli.progress_bar import progress_of_steps
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.extras import needed
from fleet_slip.selection.request import DEFAULT_MODELS


@record_run
def nightly(
    context: typer.Context,
    landing: Annotated[
        str, typer.Option(help="The folder where logs land, or s3://…; what is new in it is taken.")
    ],
    mapping: Annotated[
        str,
        typer.Option(
            help="A mapping of configs/mappings, or the path of a TOML file.",
            autocompletion=complete_config("mappings"),
        ),
    ],
    model: Annotated[str, typer.Option(help="Name of the model.", autocompletion=complete_model)],
    cohort: Annotated[
        str, typer.Option(help="SQL condition on the view drives: which drives train it.")
    ] = TRAINING_DRIVES,
    models: Models = DEFAULT_MODELS,
    worth: Worth = None,
    candidate: Annotated[
        bool, typer.Option("--candidate", help="Publish as a candidate, even what is not worse.")
    ] = False,
    retention: Annotated[
        str | None,
        typer.Option(
            help="A retention file. Default: retention.toml of the configs.", show_default=False
        ),
    ] = None,
    night: Annotated[
        str | None,
        typer.Option(help="Date of the night, YYYY-MM-DD. Default: today.", show_default=False),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write the summary there: NIGHT.txt, NIGHT.json, NIGHT.html. It names drives; "
            "forget does not reach it.",
            show_default=False,
        ),
    ] = None,
    sign_key: SignKey = None,
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
        report = fleet.nightly(
            landing,
            mapping,
            model,
            cohort=cohort,
            models=models,
            worth=worth,
            candidate=candidate,
            retention=retention,
            night=date_of(night, "--night"),
            sign_key=signing_key(sign_key),
            workers=executor,
            progress=show,
            waiting=lambda: say(f"{model}: waiting for another night"),
        )
    if output is not None:
        with needed("report", "a summary in files"):
            from fleet_slip.monitoring.night_page import write_summary  # noqa: PLC0415 - draws

        write_summary(report, output)
    if json:
        print_json(report)
    else:
        print_text(report.as_text())
    if problem := report.problem:
        raise problem
