"""Commands that look after the warehouse: verify, compact, vacuum, forget, retain."""

import sys
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import asdict
from datetime import date
from typing import Annotated, Any

import typer

from fleet_slip.cli.output import Json, print_json, print_table, progress, say
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Cluster, unless_local, workers
from fleet_slip.errors import DamageError, PendingError, QuestionError, RefusedError
from fleet_slip.maintenance.compaction import TARGET_ROWS
from fleet_slip.maintenance.compaction import compact as compact_logs
from fleet_slip.maintenance.forget import ForgetReport
from fleet_slip.maintenance.forget import forget as forget_drives
from fleet_slip.maintenance.retention import load_retention
from fleet_slip.maintenance.retention import retain as apply_retention
from fleet_slip.maintenance.vacuum import RETENTION_HOURS, VacuumReport, preview_vacuum
from fleet_slip.maintenance.vacuum import vacuum as remove_expired
from fleet_slip.maintenance.verification import Damage, Verification
from fleet_slip.maintenance.verify import verify as verify_root
from fleet_slip.runs.log import recording, step
from fleet_slip.warehouse.audit import ALLOWED, Audit, Forgettable
from fleet_slip.warehouse.tables import Warehouse

PENDING_SHOWN = 5
"""So many are named on a line; --json names all."""


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    for command in (verify, compact, vacuum, forget, retain):
        app.command()(command)


def verify(
    context: typer.Context,
    full: Annotated[
        bool, typer.Option("--full", help="Compute the Gram rows of all log files again.")
    ] = False,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair", help="Rebuild Gram rows from the logs, and simulated logs from campaigns."
        ),
    ] = False,
    campaign: Annotated[
        list[str] | None,
        typer.Option(help="A campaign's TOML file for --repair, besides those that ship."),
    ] = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Verify every byte against its checksum, and everything against everything else.

    Exits with 9 if there is damage that was not repaired.
    """
    # What repairs changes the warehouse; what only looks leaves no record.
    recorded = recording(context.obj.root, "verify", sys.argv[1:]) if repair else nullcontext()
    with recorded, workers(context, cluster) as (warehouse, executor):
        report = _verify(warehouse, executor, full=full)
        rebuilt: list[str] = []
        if repair:
            from fleet_slip.maintenance.repair import repair as rebuild  # noqa: PLC0415 - the simulator

            rebuilt = rebuild(warehouse, report, campaign or ())
            report = _verify(warehouse, executor, full=full)
    if json:
        print_json(_verified(report, rebuilt))
    else:
        _print_verification(report, rebuilt)
    if report.damage:
        advice = (
            "What is left cannot be rebuilt here: restore these files from a backup."
            if repair
            else "Rebuild what can be rebuilt with: fleet-slip verify --repair"
        )
        raise DamageError(f"{context.obj.root}: {len(report.damage)} damaged. {advice}")


def _verify(warehouse: Warehouse, executor: Executor, *, full: bool) -> Verification:
    with progress("verify", "bytes", executor) as advance:
        return verify_root(warehouse, full=full, progress=advance, executor=unless_local(executor))


def _verified(report: Verification, rebuilt: list[str]) -> dict[str, Any]:
    counts = asdict(report)
    del counts["findings"]
    return {
        **counts,
        "damage": [asdict(finding) for finding in report.damage],
        "remarks": [asdict(finding) for finding in report.findings if not finding.damage],
        "rebuilt": rebuilt,
    }


def _print_verification(report: Verification, rebuilt: list[str]) -> None:
    for path in rebuilt:
        say(f"rebuilt {path}")
    remarks = [finding for finding in report.findings if not finding.damage]
    for title, findings in (("damage", report.damage), ("remarks", remarks)):
        if findings:
            print_table(title, ["where", "problem"], map(_row, findings), left=2)
    say(
        f"{report.files} files with {report.size_bytes:,} bytes and {report.documents} documents "
        f"were read, the Gram rows of {report.log_files_recomputed} log files computed again: "
        + (f"{len(report.damage)} damaged" if report.damage else "all is as it must be")
    )


def _row(finding: Damage) -> list[str]:
    return [finding.path, finding.problem]


@record_run
def compact(
    context: typer.Context,
    target_rows: Annotated[
        int, typer.Option(min=1, help="Rows of a file after it, or fewer.")
    ] = TARGET_ROWS,
    json: Json = False,
) -> None:
    """Turn the small log files of each day into large ones. Readers and jobs are not disturbed."""
    with step("compact") as figures, progress("compact", "days") as advance:
        report = compact_logs(context.obj, target_rows, advance)
        figures.rows, figures.size_bytes = report.rows_rewritten, report.size_bytes_after
    if json:
        print_json(asdict(report))
    elif report.changed:
        say(
            f"{report.files_before} files became {report.files_after}; {report.rows_rewritten:,} "
            f"rows were written again, {report.size_bytes_before:,} bytes became "
            f"{report.size_bytes_after:,}"
        )
    else:
        say(f"nothing to do, all {report.files_after} files are large or alone in their day")


@record_run
def vacuum(
    context: typer.Context,
    retention_hours: Annotated[
        int,
        typer.Option(
            min=1, max=RETENTION_HOURS, help="Keep what a version of the last hours refers to."
        ),
    ] = RETENTION_HOURS,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the files and remove nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Remove replaced files and leftovers of killed jobs when they are old enough."""
    with step("vacuum") as figures:
        report = (preview_vacuum if dry_run else remove_expired)(context.obj, retention_hours)
        figures.size_bytes = report.size_bytes
    if json:
        print_json(asdict(report))
        return
    if dry_run and report.files:
        print_table("", ["would be removed"], ([file] for file in report.files))
    say(_vacuumed(report))


def _vacuumed(report: VacuumReport) -> str:
    done = "would be removed" if report.dry_run else "removed"
    return f"{len(report.files)} files with {report.size_bytes:,} bytes {done}"


@record_run
def forget(
    context: typer.Context,
    vehicle: Annotated[str | None, typer.Option(help="The vehicle_id to forget.")] = None,
    drive: Annotated[str | None, typer.Option(help="The drive_id to forget.")] = None,
    now: Annotated[
        bool,
        typer.Option("--now", help="Delete the old files at once, not when vacuum is due."),
    ] = False,
    allow: Annotated[
        bool,
        typer.Option("--allow", help="Let it come back: land its new rows again from now on."),
    ] = False,
    json: Json = False,
) -> None:
    """Forget a vehicle or a drive: in logs, Gram rows and quarantine; mark the models it trained.

    No job brings it back, nor one that is under way: its rows are left out, until --allow.
    `fleet-slip run` retrains. With --now it exits with 12 while anything may be left: repeat it.
    """
    if (vehicle is None) == (drive is None):
        raise typer.BadParameter("give one of --vehicle and --drive.")
    if allow and now:
        raise typer.BadParameter("give one of --allow and --now.")
    subject = Forgettable("drive", drive) if drive else Forgettable("vehicle", vehicle or "")
    if allow:
        _allow(context.obj, subject, json=json)
        return
    with step("forget") as figures, progress("forget", "files") as advance:
        report = forget_drives(context.obj, subject, now=now, progress=advance)
        figures.rows = report.rows
    if json:
        print_json(asdict(report))
    else:
        _say_forgotten(report)
    if now and report.pending:
        raise PendingError(
            f"{len(report.pending)} may still have its rows, in files that no reader sees: "
            f"{', '.join(report.pending[:PENDING_SHOWN])}. Repeat this command when they have "
            "ended, or for files of killed jobs after an hour."
        )


def _allow(warehouse: Warehouse, subject: Forgettable, *, json: bool) -> None:
    audit = Audit(warehouse.root)
    warehouse.require()
    state = audit.state(subject)
    if state is None:
        raise QuestionError(f"{subject.kind} {subject.value!r} was never forgotten.")
    if state == "begun":
        raise RefusedError(
            f"{subject.kind} {subject.value!r} is being forgotten. Give the command that forgets "
            "it again, until it is done; then allow it."
        )
    if state != ALLOWED:
        audit.allow(subject)
    if json:
        print_json({"allowed": True, "changed": state != ALLOWED})
    else:
        say("its new rows are landed again from now on; what was forgotten stays forgotten")


def _say_forgotten(report: ForgetReport) -> None:
    if not report.changed:
        say("nothing to do, it was forgotten before")
        return
    say(
        f"{report.drives} drives forgotten, {report.rows:,} rows: {report.files_rewritten} files "
        f"written again without them, {report.files_removed} removed"
    )
    if report.old_files_deleted:
        say(f"{report.old_files_deleted} old files with them deleted")
    if report.old_files_left:
        say(
            f"{report.old_files_left} old files still have them until fleet-slip vacuum is due; "
            "repeat with --now to delete them at once"
        )
    if report.models:
        say(f"trained on them: {', '.join(report.models)}. Train again with: fleet-slip run")


@record_run
def retain(
    context: typer.Context,
    config: Annotated[
        str | None,
        typer.Option(help="A retention TOML file. Default: configs/retention.toml as it ships."),
    ] = None,
    json: Json = False,
) -> None:
    """Forget drives that are older than the retention says, then vacuum. For a schedule."""
    with step("retain") as figures, progress("retain", "files") as advance:
        report = apply_retention(context.obj, load_retention(config), date.today(), advance)
        figures.rows, figures.size_bytes = report.forgotten.rows, report.vacuumed.size_bytes
    if json:
        print_json(asdict(report))
        return
    if report.forgotten.changed:
        _say_forgotten(report.forgotten)
    else:
        say(f"no drive is older than {report.before}")
    say(_vacuumed(report.vacuumed))
