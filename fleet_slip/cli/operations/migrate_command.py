"""The command that brings the logs to the signal catalogue: migrate."""

import typer

from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.record_runs import record_run
from fleet_slip.words import number_of


@record_run
def migrate(context: typer.Context, json: Json = False) -> None:
    """Bring the logs to the signal catalogue: add columns, convert counts to other scales.

    See docs/schema.md before widening a scale. It can be repeated after any interruption.

    Example: **fleet-slip migrate**
    """
    with progress("migrate", "rows") as show:
        report = context.obj.migrate(progress=show)
    if json:
        print_json(report)
        return
    if not report.changed:
        say("migrate: nothing to do, the logs agree with the signal catalogue")
    if report.added:
        say(f"added: {', '.join(report.added)}; null in the files that are there")
    for name, (old, new) in report.rescaled.items():
        say(f"{name}: counts of {old} are now counts of {new}")
    if report.files_without_names:
        files = number_of(report.files_without_names, "file")
        say(f"{files} written anew, without names that none of their rows has")
    if report.files_rewritten:
        say(
            f"{number_of(report.files_rewritten, 'file')}, "
            f"{number_of(report.rows_rewritten, 'row')} rewritten. Run: "
            "fleet-slip gram"
        )
