"""Commands that keep a warehouse in service: status, quality."""

from typing import Annotated, Any

import typer

from fleet_slip.cli.output import Json, print_json, print_table
from fleet_slip.cohort import TRAINING_DRIVES, load_cohort
from fleet_slip.errors import AlarmError
from fleet_slip.operations.quality import QualityReport, examine
from fleet_slip.operations.status import Status, status_of


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(status)
    app.command()(quality)


def status(
    context: typer.Context,
    max_age_hours: Annotated[
        float | None,
        typer.Option(min=0, help="Data, or a backlog, older than this is a problem."),
    ] = None,
    json: Json = False,
) -> None:
    """Tell the warehouse's health: freshness, backlog, last runs, disk, champions.

    Exit code 10 if something calls for attention.
    """
    found = status_of(context.obj, max_age_hours)
    if json:
        print_json(found.as_dict())
    else:
        _print_status(found)
    if found.problems:
        raise AlarmError("; ".join(found.problems))


def _print_status(found: Status) -> None:
    print_table(
        f"{found.root} at {found.checked_at:%Y-%m-%d %H:%M} UTC",
        ["table", "last commit", "version", "files", "rows", "size MB"],
        [
            [
                name,
                f"{one.committed_at:%Y-%m-%d %H:%M}" if one.committed_at else "never",
                "" if one.version is None else str(one.version),
                f"{one.files:,}",
                f"{one.rows:,}",
                f"{one.size_bytes / 1e6:,.1f}",
            ]
            for name, one in found.tables.items()
        ],
        left=2,
    )
    print_table(
        "",
        ["", ""],
        [
            ["newest day", str(found.newest_day or "none")],
            [
                "waiting for the Gram job",
                f"{found.backlog_files} files, {found.backlog_rows:,} rows",
            ],
            ["disk", f"{found.disk_free_bytes / 1e9:,.1f} GB free, {found.disk_free_fraction:.0%}"],
        ],
        left=2,
    )
    _print_runs(found)
    if found.champions:
        print_table(
            "\nchampions",
            ["model", "published", "age h", "logs behind", "grams behind"],
            [
                [
                    f"{one.model}@{one.version}",
                    f"{one.published_at:%Y-%m-%d %H:%M}" if one.published_at else "",
                    "" if one.age_hours is None else f"{one.age_hours:,.1f}",
                    str(one.logs_behind),
                    str(one.grams_behind),
                ]
                for one in found.champions
            ],
            left=2,
        )


def _print_runs(found: Status) -> None:
    if not found.last_runs:
        return
    print_table(
        "\nlast runs",
        ["command", "started", "state", "seconds", "rows"],
        [
            [
                run["command"],
                f"{run['started_at']:%Y-%m-%d %H:%M:%S}",
                run["state"],
                _number(run["seconds"], ".1f"),
                _number(run["rows"], ","),
            ]
            for run in found.last_runs
        ],
        left=3,
    )


def quality(
    context: typer.Context,
    cohort: Annotated[
        str,
        typer.Option(help="SQL condition on the view drives: which drives to examine together."),
    ] = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by drive.

    Reads Gram rows only. Exit code 10 if a drive's sensors are not in order.
    """
    found = examine(load_cohort(context.obj, cohort))
    if json:
        print_json(found.as_dict())
    else:
        _print_quality(found)
    if found.findings:
        raise AlarmError(
            f"the sensors of {len(found.findings)} of {found.drives} drives are not in order"
        )


def _print_quality(found: QualityReport) -> None:
    print_table(
        f"{found.drives:,} drives examined, {found.compared:,} of them beside their peers",
        ["drive", "car", "fault", "signals", "what shows it"],
        [
            [
                finding.drive_id,
                finding.vehicle_id,
                finding.fault.kind,
                " ".join(finding.fault.signals),
                finding.fault.figure,
            ]
            for finding in found.findings
        ],
        left=5,
    )


def _number(value: Any, form: str) -> str:
    return "" if value is None else format(value, form)
