"""Commands of operations, such as status, contract, quality, monitor, verify and forget."""

from pathlib import Path
from typing import Annotated

from typer import Context, Option

from fleet_slip.catalog.signals import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import (
    print_answer,
    print_json,
    print_text,
    progress,
    progress_of_steps,
    say,
    write_text,
)
from fleet_slip.errors import UsageError


def status(
    context: Context,
    max_age_hours: Annotated[
        float | None, Option(min=0, help="Maximum age of data or of a backlog, in hours.")
    ] = None,
    json: opt.Json = False,
) -> None:
    """Report the health of the data root: freshness, backlog, last runs, disk, champions.

    Exit code 10 if something needs attention.

    Example: fleet-slip status --max-age-hours 26
    """
    print_answer(fleet_of(context).maintenance.status(max_age_hours), json)


def contract(
    context: Context,
    output: Annotated[
        Path | None, Option(help="File to write, .odcs.yaml. Default: stdout.")
    ] = None,
) -> None:
    """Write the data contract of the views in ODCS 3.1: columns, units, ranges and keys.

    Example: fleet-slip contract --output fleet.odcs.yaml
    """
    from fleet_slip.operations.data_contract import data_contract

    text = data_contract(fleet_of(context).warehouse)
    if output is None:
        print_text(text.removesuffix("\n"))
        return
    write_text(output, text)
    say(f"{output}: {len(text):,} characters. Check it by: datacontract lint {output}")


def quality(context: Context, cohort: opt.Cohort = TRAINING_DRIVES, json: opt.Json = False) -> None:
    """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by drive.

    Reads the Gram rows of all drives, and the log rows of the 20 longest measured drives.
    Exit code 10 if a drive has faulty sensors.

    Example: fleet-slip quality --cohort "day >= '2024-05-02'"
    """
    print_answer(fleet_of(context).maintenance.quality(cohort), json)


def calibrate(
    context: Context,
    cohort: opt.Cohort = ALL_DRIVES,
    car: Annotated[
        str | None,
        Option(help="vehicle_id: print the parameters of this car, also as on-board constants."),
    ] = None,
    json: opt.Json = False,
) -> None:
    """Estimate the sensor errors of each car from its own drives, without label or log rows.

    Offsets of gyroscope, accelerometer and steering, tyre radius, steering ratio and understeer,
    each with its uncertainty. Reads the Gram rows of: fleet-slip gram --features calibration.

    Example: fleet-slip calibrate
    """
    print_answer(fleet_of(context).maintenance.calibrate(cohort), json, car=car)


def monitor(
    context: Context,
    model: opt.Model = None,
    cohort: Annotated[
        str | None, Option(help="SQL predicate on the view drives. Default: that of the training.")
    ] = None,
    since: Annotated[
        str | None,
        Option(help="First new day, YYYY-MM-DD. Default: the day after the training data."),
    ] = None,
    json: opt.Json = False,
) -> None:
    """Chart a model's error on each day since its training, with control limits.

    Default: the predicate of its training, from the day after the training data.

    Reads Gram rows only. Exit code 10 if a new day is beyond the limits.

    Example: fleet-slip monitor waterford --since 2024-05-03
    """
    print_answer(fleet_of(context).maintenance.monitor(model, cohort, since=since), json)


def verify(
    context: Context,
    full: Annotated[
        bool, Option("--full", help="Compute the Gram rows of all log files again.")
    ] = False,
    grams: Annotated[
        bool, Option("--grams", help="Compute some Gram rows in several ways; compare the bits.")
    ] = False,
    repair: Annotated[
        bool, Option("--repair", help="Rebuild damaged Gram rows from the logs.")
    ] = False,
    accept_loss: Annotated[
        list[str] | None,
        Option(
            help="Lost document without a backup to give up: FOLDER/NUMBER.json, or FOLDER for all "
            "its documents. May be repeated."
        ),
    ] = None,
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    json: opt.Json = False,
) -> None:
    """Verify every byte against its checksum, and all tables against each other.

    Exit code 9 if there is damage that was not repaired.

    Example: fleet-slip verify --full
    """
    with progress_of_steps() as show:
        verification = fleet_of(context).maintenance.verify(
            full=full,
            grams=grams,
            repair=repair,
            accept_loss=accept_loss or (),
            workers=cluster or threads,
            progress=show,
        )
    print_answer(verification, json)


def compact(
    context: Context,
    target_rows: Annotated[
        int | None, Option(min=1, help="Maximum number of rows of a file. Default: 2,000,000.")
    ] = None,
    retention_hours: Annotated[
        float | None,
        Option(
            min=1,
            max=168,
            help="Hours for which files of replaced versions are kept. Default: 168, a week.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="List the files to be removed; change nothing.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Merge the small log files of each day, and remove files that are out of use.

    Replaced files and leftovers of killed jobs are removed when they are old enough. Readers and
    jobs are not disturbed.

    Example: fleet-slip compact
    """
    with progress("compact") as show:
        report = fleet_of(context).maintenance.compact(
            target_rows, retention_hours=retention_hours, dry_run=dry_run, progress=show
        )
    print_answer(report, json)


def forget(
    context: Context,
    vehicle: Annotated[str | None, Option(help="vehicle_id to erase.")] = None,
    drive: Annotated[str | None, Option(help="drive_id to erase.")] = None,
    now: Annotated[
        bool, Option("--now", help="Delete old files at once, instead of by compact.")
    ] = False,
    allow: Annotated[
        bool, Option("--allow", help="Accept new rows of the vehicle or drive again.")
    ] = False,
    expired: Annotated[
        bool, Option("--expired", help="Erase drives older than the retention period.")
    ] = False,
    retention: opt.Retention = None,
    json: opt.Json = False,
) -> None:
    """Erase a vehicle or a drive from logs, Gram rows and quarantine; mark models it trained.

    Jobs that are running leave its rows out, too, until --allow. Train the models again with:
    fleet-slip publish NAME. With --now the exit code is 12 while rows may remain: repeat it.

    Example: fleet-slip forget --vehicle car-7 --now
    """
    maintenance = fleet_of(context).maintenance
    if expired or retention is not None:
        if not expired or allow or now or vehicle or drive:
            raise UsageError("give --expired alone, or with --retention.")
        with progress("retain") as show:
            print_answer(maintenance.apply_retention(retention, progress=show), json)
    elif allow:
        if now:
            raise UsageError("give one of --allow and --now.")
        changed = maintenance.allow(vehicle=vehicle, drive=drive)
        if json:
            print_json({"allowed": True, "changed": changed})
        else:
            say("its new rows are accepted again from now on; what was forgotten stays forgotten")
    else:
        with progress("forget") as show:
            report = maintenance.forget(vehicle=vehicle, drive=drive, now=now, progress=show)
        print_answer(report, json)
        if now:
            report.require_all()


def migrate(context: Context, json: opt.Json = False) -> None:
    """Bring the data root to this program and to the signal catalog: add columns.

    It can be repeated after any interruption.

    Example: fleet-slip migrate
    """
    print_answer(fleet_of(context).maintenance.migrate(), json)
