"""The command that takes in messages of cars that send Gram rows: receive."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.cli.output import Json, print_json, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.record_runs import record_run
from fleet_slip.errors import InputError
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.grams.received.receiving import ReceiveReport


@record_run
def receive(
    context: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Files of messages, one behind the other, or folders of them.", show_default=False
        ),
    ],
    json: Json = False,
) -> None:
    """Take in messages of cars that send Gram rows instead of logs.

    What is damaged or impossible goes to the quarantine with a reason: fleet-slip sql "FROM
    quarantine"; a file of which all does is an error, and so is one that cannot be read, when the
    others are in.

    Example: **fleet-slip receive messages/2024-05-01**
    """
    reports: list[ReceiveReport] = []
    try:
        with progress("receive", "files") as show:
            context.obj.receive(files, each=reports.append, progress=show)
    finally:
        if json:
            print_json(reports)
        else:
            for report in reports:
                say(_said(report))
    if useless := [report.file for report in reports if report.is_useless]:
        raise InputError(
            f"{useless[0]}: no message in it can be used"
            + (f", nor in {number_of(len(useless) - 1, 'other file')}" if useless[1:] else "")
            + '. Why is in the quarantine: fleet-slip sql "FROM quarantine"'
        )


def _said(report: "ReceiveReport") -> str:
    if not report.new:
        return f"{report.file}: nothing to do, it was received before"
    parts = [
        f"{number_of(report.messages, 'message')}, {number_of(report.received, 'new Gram row')} of "
        f"{number_of(report.rows, 'row')}"
    ]
    if report.duplicates:
        parts.append(f"{number_of(report.duplicates, 'duplicate')}")
    if report.forgotten:
        parts.append(f"{number_of(report.forgotten, 'message')} of what was forgotten left out")
    if report.refused:
        reasons = ", ".join(f"{count:,} {reason}" for reason, count in report.refused.items())
        parts.append(f"in quarantine: {reasons}")
    return f"{report.file}: {'; '.join(parts)}"
