"""Commands that look after the warehouse: verify, compact, forget, migrate."""

from typing import Annotated

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.api.operations import Compacted
from fleet_slip.base import number_of
from fleet_slip.cli.options import command
from fleet_slip.cli.output import Json, print_json, print_records, print_table, say
from fleet_slip.cli.progress import progress
from fleet_slip.errors import DamageError, PendingError, UsageError
from fleet_slip.grams.check import CheckReport
from fleet_slip.operations.find_drives import VacuumReport
from fleet_slip.operations.forget import ForgetReport
from fleet_slip.operations.migration import MigrationReport
from fleet_slip.operations.verify import Verification

PENDING_SHOWN = 5
"""So many are named on a line; --json names all."""


@command(Fleet.verify, progress=("verify", "bytes"), campaigns="--campaign")
def verify(report: Verification, fleet: Fleet, repair: bool, json: Json = False) -> None:
    """Verify every byte against its checksum, and everything against everything else.

    Exits with 9 if there is damage that was not repaired.

    Example: **fleet-slip verify --full**
    """
    if json:
        print_json(report)
    else:
        _print_verification(report)
    if report.damage:
        advice = (
            "What is left cannot be rebuilt here: restore these files from a backup. Data files "
            "may be copied below their table under any name; then give the command again."
            if repair
            else "Rebuild what can be rebuilt with: fleet-slip verify --repair"
        )
        raise DamageError(f"{fleet.root}: {len(report.damage)} damaged. {advice}")


def _print_verification(report: Verification) -> None:
    for path in report.rebuilt:
        say(f"rebuilt {path}")
    for title in ("damage", "remarks"):
        if findings := getattr(report, title):
            print_records(title, "where|problem", "{path}|{problem}", findings, left=2)
    say(
        f"{number_of(report.files, 'file')} with {report.size_bytes:,} bytes and "
        f"{number_of(report.documents, 'document')} were read, the Gram rows of "
        f"{number_of(report.log_files_recomputed, 'log file')} computed again: "
        + (f"{len(report.damage)} damaged" if report.damage else "all is as it must be")
    )
    if report.compared:
        _print_ways(report.compared)


def _print_ways(report: CheckReport) -> None:
    ways = dict.fromkeys(("SQL against stored Gram rows", "SQL against the kernel"), report.drives)
    if report.wide_sets:
        ways[f"SQL against the kernel: {', '.join(report.wide_sets)}"] = report.wide_drives
    rows = [[way, f"{drives}", "yes"] for way, drives in ways.items()]
    print_table("", ["way", "drives", "equal"], rows)


@command(Fleet.compact, progress=("compact", "days"))
def compact(done: Compacted) -> None:
    """Turn the small log files of each day into large ones, and remove files out of use.

    Replaced files and leftovers of killed jobs go when they are old enough. Readers and jobs are
    not disturbed.

    Example: **fleet-slip compact**
    """
    compacted, vacuumed = done.compacted, done.vacuumed
    if compacted is None:
        if vacuumed.files:
            print_table("", ["would be removed"], ([file] for file in vacuumed.files))
    elif compacted.changed:
        say(
            f"{number_of(compacted.files_before, 'file')} became {compacted.files_after}; "
            f"{compacted.rows_rewritten:,} rows were written again, "
            f"{compacted.size_bytes_before:,} bytes became {compacted.size_bytes_after:,}"
        )
    else:
        files = number_of(compacted.files_after, "file")
        say(f"nothing to compact: {files}, large or alone in the day")
    say(_vacuumed(vacuumed))


def _vacuumed(report: VacuumReport) -> str:
    done = "would be removed" if report.dry_run else "removed"
    return f"{number_of(len(report.files), 'file')} with {report.size_bytes:,} bytes {done}"


@command(Fleet.forget)
def forget(
    fleet: Fleet,
    now: bool,
    allow: Annotated[
        bool, typer.Option("--allow", help="Let it come back: take its new rows again from now on.")
    ] = False,
    expired: Annotated[
        bool,
        typer.Option(
            "--expired", help="Forget drives older than the retention says, for a schedule."
        ),
    ] = False,
    retention: Annotated[
        str | None,
        typer.Option(help="With --expired: a TOML file. Default: retention.toml of the configs."),
    ] = None,
    json: Json = False,
    **subject: str | None,
) -> None:
    """Forget a vehicle or drives: in logs, Gram rows and quarantine; mark the models they trained.

    No job brings it back, nor one that is under way: its rows are left out, until --allow.
    `fleet-slip run` retrains. With --now it exits with 12 while anything may be left: repeat it.

    Example: **fleet-slip forget --vehicle car-7 --now**
    """
    if expired or retention is not None:
        if not expired or allow or now or any(subject.values()):
            raise UsageError("give --expired alone, or with --retention.")
        _forget_expired(fleet, retention, json)
    elif allow:
        if now:
            raise UsageError("give one of --allow and --now.")
        if subject.pop("drive_name") is not None:
            raise UsageError("give --allow with --vehicle, --drive or --source-file.")
        changed = fleet.allow(**subject)
        if json:
            print_json({"allowed": True, "changed": changed})
        else:
            say("its new rows are taken again from now on; what was forgotten stays forgotten")
    else:
        with progress("forget", "files") as show:
            report = fleet.forget(**subject, now=now, progress=show)
        if json:
            print_json(report)
        else:
            _say_forgotten(report)
        if now and report.pending:
            raise PendingError(
                f"{len(report.pending)} may still have its rows, in files that no reader sees: "
                f"{', '.join(report.pending[:PENDING_SHOWN])}. Repeat this command when they have "
                "ended, or for files of killed jobs after an hour."
            )


def _say_forgotten(report: ForgetReport) -> None:
    if not report.changed:
        say("nothing to do, it was forgotten before")
        return
    say(
        f"{number_of(report.drives, 'drive')} forgotten, {number_of(report.rows, 'row')}: "
        f"{number_of(report.files_rewritten, 'file')} "
        f"written again without them, {report.files_removed} removed"
    )
    if report.old_files_deleted:
        say(f"{report.old_files_deleted} old files with them deleted")
    if report.old_files_left:
        say(
            f"{report.old_files_left} old files still have them until fleet-slip compact removes "
            "them; repeat with --now to delete them at once"
        )
    if report.models:
        say(f"trained on them: {', '.join(report.models)}. Train again with: fleet-slip run")


def _forget_expired(fleet: Fleet, retention: str | None, json: bool) -> None:
    with progress("retain", "files") as show:
        report = fleet.retain(retention, progress=show)
    if json:
        print_json(report)
        return
    if report.forgotten.changed:
        _say_forgotten(report.forgotten)
        say(
            "their files are not read again; drives as old that come in other files do, until the "
            "next forget --expired"
        )
    else:
        say(f"no drive is older than {report.before}")
    say(_vacuumed(report.vacuumed))


# The command that brings the logs to the signal catalogue: migrate.


@command(Fleet.migrate)
def migrate(report: MigrationReport) -> None:
    """Bring the data root to this program and to the signal catalogue: add columns.

    It can be repeated after any interruption.

    Example: **fleet-slip migrate**
    """
    if not report.changed:
        say("migrate: nothing to do, the logs agree with the signal catalogue")
    if report.added:
        say(f"added: {', '.join(report.added)}; null in the files that are there")
    if report.files_without_names:
        files = number_of(report.files_without_names, "file")
        say(f"{files} written anew, without names that none of their rows has")
