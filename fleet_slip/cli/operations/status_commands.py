"""The command that tells the health of the warehouse: status."""

import logging
from collections.abc import Sequence
from typing import Annotated

import typer

from fleet_slip.cli.output import Json, cell, print_json, print_table, print_text, say
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.monitoring.status import WarehouseStatus
from fleet_slip.words import number_of


def status(
    context: typer.Context,
    max_age_hours: Annotated[
        float | None, typer.Option(min=0, help="Data, or a backlog, older than this is a problem.")
    ] = None,
    prometheus: Annotated[
        bool,
        typer.Option("--prometheus", help="Print metrics, for the textfile collector of a node."),
    ] = False,
    json: Json = False,
) -> None:
    """Tell the warehouse's health: freshness, backlog, last runs, disk, champions.

    Exit code 10 if something calls for attention.

    Example: **fleet-slip status --max-age-hours 26**
    """
    if json and prometheus:
        raise UsageError("give one of --json and --prometheus.")
    found: WarehouseStatus = context.obj.status(max_age_hours)
    if prometheus:
        from fleet_slip.monitoring.prometheus import as_openmetrics  # noqa: PLC0415 - seldom asked

        print_text(as_openmetrics(found).removesuffix("\n"))
    elif json:
        print_json(found)
    else:
        _print_status(found)
    _complain(found.problems)


def _complain(problems: Sequence[str]) -> None:
    """Say what calls for attention, a line each, if anything does."""
    for problem in problems:
        say(f"- {problem}", logging.ERROR)
    if problems:
        raise AlarmError(f"{number_of(len(problems), 'matter')}, above, to be looked after.")


def _print_status(found: WarehouseStatus) -> None:
    print_table(
        f"{found.root} at {found.checked_at:%Y-%m-%d %H:%M} UTC",
        ["table", "last commit", "version", "files", "rows", "size MB"],
        [
            [
                name,
                f"{one.committed_at:%Y-%m-%d %H:%M}" if one.committed_at else "never",
                cell(one.version),
                f"{one.files:,}",
                f"{one.rows:,}",
                f"{one.size_bytes / 1e6:,.1f}",
            ]
            for name, one in found.tables.items()
        ],
        left=2,
    )
    backlog = f"{number_of(found.backlog_files, 'file')}, {number_of(found.backlog_rows, 'row')}"
    facts = {"newest day": str(found.newest_day or "none"), "waiting for the Gram job": backlog}
    if found.disk_free_bytes is not None and found.disk_free_fraction is not None:
        free = f"{found.disk_free_bytes / 1e9:,.1f} GB free, {found.disk_free_fraction:.0%}"
        facts["disk"] = free
    print_table("", ["", ""], facts.items(), left=2)
    if found.last_runs:
        print_table(
            "\nlast runs",
            ["command", "started", "state", "seconds", "rows"],
            [
                [
                    run["command"],
                    f"{run['started_at']:%Y-%m-%d %H:%M:%S}",
                    run["state"],
                    cell(run["seconds"], ".1f"),
                    cell(run["rows"], ","),
                ]
                for run in found.last_runs
            ],
            left=3,
        )
    if found.champions:
        print_table(
            "\nchampions",
            ["model", "published", "age h", "logs behind", "grams behind"],
            [
                [
                    f"{one.model}@{one.version}",
                    cell(one.published_at, "%Y-%m-%d %H:%M"),
                    cell(one.age_hours, ",.1f"),
                    str(one.logs_behind),
                    str(one.grams_behind),
                ]
                for one in found.champions
            ],
            left=2,
        )
