"""Commands of operations: nights, health, sensors and drift; verify, compact, forget, migrate."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.cli.options import command
from fleet_slip.cli.output import Json, print_answer, print_json, say
from fleet_slip.cli.progress import progress
from fleet_slip.errors import UsageError

if TYPE_CHECKING:
    from fleet_slip.operations.night import NightReport
    from fleet_slip.operations.status import WarehouseStatus


@command(Fleet.status)
def status(found: "WarehouseStatus", json: Json = False) -> None:
    """Report the warehouse's health: freshness, backlog, last runs, disk, champions.

    Exit code 10 if something calls for attention.

    Example: fleet-slip status --max-age-hours 26
    """
    print_answer(found, json)
    for problem in found.problems:
        say(f"- {problem}", logging.ERROR)


@command(Fleet.quality)
def quality() -> None:
    """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by drive.

    Reads Gram rows only. Exit code 10 if a drive has faulty sensors.

    Example: fleet-slip quality --cohort "day >= '2024-05-02'"
    """


@command(Fleet.calibrate)
def calibrate(
    car: Annotated[
        str | None,
        typer.Option(help="Show this car's numbers, and how they go on board.", show_default=False),
    ] = None,
) -> None:
    """Estimate the sensor errors of each car from its own drives, without label or log rows.

    Offsets of gyroscope, accelerometer and steering, tyre radius, steering and understeer, each
    with its uncertainty. Needs the Gram rows of: fleet-slip
    gram --features calibration.

    Example: fleet-slip calibrate
    """


@command(Fleet.monitor, arguments=["model"])
def monitor() -> None:
    """Chart a model's error on each day since it was trained, with control limits.

    Reads Gram rows only. Exit code 10 if a new day is beyond the limits.

    Example: fleet-slip monitor waterford --since 2024-05-03
    """


@command(Fleet.nightly, progress="", name="--model")
def nightly(
    report: "NightReport",
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write the summary there: NIGHT.txt and NIGHT.json. It names drives; "
            "forget does not reach it.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Run the nightly job: ingest new logs, check their sensors, train again, verify.

    Drives with faulty sensors train no model. The winner becomes champion if it is not worse, else
    a candidate. Killed at any moment and given again, it ends where it would have ended. Exits with
    10 if something calls for attention, else with the code of the first step that failed.

    Example: fleet-slip nightly --landing /srv/logs --mapping logger.toml --model fleet
    """
    if output is not None:
        from fleet_slip.operations.night import write_summary  # noqa: PLC0415 - loaded by now

        write_summary(report, output)
    print_answer(report, json)


@command(Fleet.verify, progress="verify")
def verify() -> None:
    """Verify every byte against its checksum, and all tables against each other.

    Exits with 9 if there is damage that was not repaired.

    Example: fleet-slip verify --full
    """


@command(Fleet.compact, progress="compact")
def compact() -> None:
    """Turn the small log files of each day into large ones, and remove files out of use.

    Replaced files and leftovers of killed jobs go when they are old enough. Readers and jobs are
    not disturbed.

    Example: fleet-slip compact
    """


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
    """Forget a vehicle or a drive: in logs, Gram rows and quarantine; mark models it trained.

    No job brings it back, nor one that is under way: its rows are left out, until --allow.
    Train them again with `fleet-slip publish NAME`. With --now it exits with 12 while anything may
    be left: repeat it.

    Example: fleet-slip forget --vehicle car-7 --now
    """
    if expired or retention is not None:
        if not expired or allow or now or any(subject.values()):
            raise UsageError("give --expired alone, or with --retention.")
        with progress("retain") as show:
            print_answer(fleet.retain(retention, progress=show), json)
    elif allow:
        if now:
            raise UsageError("give one of --allow and --now.")
        changed = fleet.allow(**subject)
        if json:
            print_json({"allowed": True, "changed": changed})
        else:
            say("its new rows are accepted again from now on; what was forgotten stays forgotten")
    else:
        with progress("forget") as show:
            report = fleet.forget(**subject, now=now, progress=show)
        print_answer(report, json)
        if now:
            report.require_all()


@command(Fleet.migrate)
def migrate() -> None:
    """Bring the data root to this program and to the signal catalog: add columns.

    It can be repeated after any interruption.

    Example: fleet-slip migrate
    """
