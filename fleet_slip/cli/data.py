"""Commands that fill the warehouse: simulate, ingest, gram, check."""

import logging
from concurrent.futures import Executor
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.output import Json, print_json, print_table, progress, say
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Cluster, Threads, unless_local, workers
from fleet_slip.errors import ConfigError
from fleet_slip.grams.check import check_grams
from fleet_slip.grams.job import GramReport, update_grams
from fleet_slip.grams.reader import cohort_files
from fleet_slip.grams.statement import gram_statement
from fleet_slip.runs.log import step
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse

if TYPE_CHECKING:
    from fleet_slip.simulation.campaign import Campaign
    from fleet_slip.simulation.job import SimulationReport

ALL_SETS = "all"
"""Instead of the name of a feature set: every one."""

CampaignName = Annotated[
    str, typer.Argument(help="A campaign of configs/campaigns, or the path of a TOML file.")
]
Through = Annotated[
    str | None,
    typer.Option(help="Last day to simulate, YYYY-MM-DD or today. Default: all days."),
]
Days = Annotated[
    int | None, typer.Option(min=1, help="Simulate the first N days only. Default: all.")
]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(simulate)
    app.command()(ingest)
    app.command()(gram)
    app.command()(check)


def chosen_days(campaign: "Campaign", days: int | None, through: str | None) -> tuple[date, ...]:
    """Return the days of a campaign that the options ask for. Raises `ConfigError`."""
    try:
        last = _date(through) if through else date.max
    except ValueError:
        raise ConfigError(
            f"--through {through}: not a date; write it as 2024-05-01, or today."
        ) from None
    chosen = tuple(day for day in campaign.days()[:days] if day <= last)
    if not chosen:
        first, end = campaign.days()[0], campaign.days()[-1]
        raise ConfigError(f"--through {through}: {campaign.name} lasts from {first} to {end}.")
    return chosen


def _date(text: str) -> date:
    return date.today() if text == "today" else date.fromisoformat(text)


def run_simulation(
    warehouse: Warehouse, campaign: "Campaign", days: tuple[date, ...], executor: Executor
) -> "SimulationReport":
    """Simulate with a progress bar."""
    from fleet_slip.simulation.job import simulate_campaign  # noqa: PLC0415 - the simulator

    with (
        step("simulate") as figures,
        progress(f"simulate {campaign.name}", "rows", executor) as advance,
    ):
        report = simulate_campaign(warehouse, campaign, days, executor, advance)
        figures.rows, figures.size_bytes = report.rows, report.size_bytes
    return report


def run_gram(
    warehouse: Warehouse,
    executor: Executor,
    feature_set: str = PLAIN,
    cohort: str | None = None,
) -> GramReport:
    """Run the Gram job for a feature set with a progress bar; for the files of a cohort, or all."""
    among = cohort_files(warehouse, parse_condition(cohort)) if cohort else None
    with step("gram") as figures, progress(f"gram {feature_set}", "rows", executor) as advance:
        report = update_grams(warehouse, advance, feature_set, unless_local(executor), among)
        figures.rows = report.rows_read
    return report


@record_run
def simulate(
    context: typer.Context,
    campaign: CampaignName,
    days: Days = None,
    through: Through = None,
    threads: Threads = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Simulate what is missing of a campaign and write it to the logs."""
    from fleet_slip.simulation.campaign import load_campaign  # noqa: PLC0415 - takes a while

    plan = load_campaign(campaign)
    chosen = chosen_days(plan, days, through)
    with workers(context, cluster, threads) as (warehouse, executor):
        report = run_simulation(warehouse, plan, chosen, executor)
    if json:
        print_json(asdict(report))
    elif report.changed:
        say(
            f"{plan.name}: {report.drives} drives, {report.rows:,} rows in "
            f"{report.batches_written} files, {report.size_bytes / max(report.rows, 1):.1f} bytes "
            f"a row{_left_out(report.drives_forgotten)}"
        )
        say(_where_the_time_went(report))
    else:
        say(f"{plan.name}: nothing to do, all {len(chosen)} days are there")


def _left_out(drives: int) -> str:
    if not drives:
        return ""
    return f"; {drives} drives left out, forgotten (fleet-slip forget --allow lets them come back)"


def _where_the_time_went(report: "SimulationReport") -> str:
    seconds = report.seconds
    shares = ", ".join(
        f"{name} {spent / seconds.tasks:.0%}"
        for name, spent in (
            ("simulate", seconds.simulate),
            ("encode", seconds.encode),
            ("write", seconds.write),
        )
    )
    return (
        f"{seconds.elapsed:.1f} s, {report.rows / seconds.elapsed:,.0f} rows/s: "
        f"{seconds.tasks / seconds.elapsed:.1f} workers busy ({shares}), commits "
        f"{seconds.commit:.1f} s"
    )


@record_run
def ingest(
    context: typer.Context,
    files: Annotated[list[Path], typer.Argument(help="CSV or Parquet files.", show_default=False)],
    mapping: Annotated[
        str, typer.Option(help="A mapping of configs/mappings, or the path of a TOML file.")
    ],
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Bring measured logs into the warehouse through a mapping of columns, units and axes.

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"
    """
    from fleet_slip.ingest.job import ingest_files  # noqa: PLC0415
    from fleet_slip.ingest.mapping import load_mapping  # noqa: PLC0415 - Polars takes a while

    plan = load_mapping(mapping)
    reports = {}
    if cluster:  # a worker has a working directory of its own
        files = [file.absolute() for file in files]
    with (
        workers(context, cluster) as (warehouse, executor),
        step("ingest") as figures,
    ):
        figures.rows = 0
        for done in ingest_files(warehouse, files, plan, unless_local(executor)):
            report = reports[done.file] = done.as_dict()
            figures.rows += report["ticks"] if report["new"] else 0
            if not json:
                say(_ingested(report))
            for names in done.look_alikes:
                say(_look_alike(done.file, names), logging.WARNING)
    if json:
        print_json([reports[str(file)] for file in files])


def _look_alike(file: str, names: tuple[str, ...]) -> str:
    return (
        f"{file}: the names {' and '.join(map(ascii, names))} look the same and count as several: "
        "they differ in their Unicode form. Write such names in one form in the files or the "
        "mapping, normally NFC."
    )


def _ingested(report: dict[str, Any]) -> str:
    if not report["new"] and not report["drives_forgotten"]:
        return f"{report['file']}: nothing to do, it was ingested before"
    reasons = ", ".join(f"{n:,} {reason}" for reason, n in report["quarantined"].items())
    return (
        f"{report['file']}: {report['ticks']:,} rows in {report['drives']} drives"
        + (f"; {report['rows_quarantined']:,} rows in quarantine ({reasons})" if reasons else "")
        + _left_out(report["drives_forgotten"])
    )


@record_run
def gram(
    context: typer.Context,
    feature_set: Annotated[
        str,
        typer.Option(
            "--features",
            help="A feature set of configs/features.toml; signals is the logged signals "
            "themselves, all is every set.",
        ),
    ] = PLAIN,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="Read only the log files that have a drive of this cohort, an SQL condition on "
            "the view drives. Default: all.",
            show_default=False,
        ),
    ] = None,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement and do nothing.")] = False,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Reduce new log files to Gram rows, and drop the rows of files that are gone.

    A feature set that is asked for the first time costs one pass over the logs; from then on only
    new files are read.
    """
    names = (PLAIN, *features().sets) if feature_set == ALL_SETS else (feature_set,)
    if sql:
        for name in names:
            typer.echo(gram_statement(catalogue(), name))
        return
    with workers(context, cluster) as (warehouse, executor):
        if cohort:  # which files have its drives is known from the logged signals' Gram rows
            run_gram(warehouse, executor)
        reports = [run_gram(warehouse, executor, name, cohort) for name in names]
    if json:
        documents = [asdict(report) for report in reports]
        print_json(documents if feature_set == ALL_SETS else documents[0])
        return
    for report in reports:
        _say_gram(report)


def _say_gram(report: GramReport) -> None:
    if report.changed:
        say(
            f"gram {report.feature_set}: {report.files_read} new files, {report.rows_read:,} rows "
            f"read, {report.files_dropped} files dropped; {report.gram_rows:,} Gram rows in all"
        )
    else:
        say(
            f"gram {report.feature_set}: nothing to do, {report.gram_rows:,} Gram rows in all are "
            "up to date"
        )


def check(
    context: typer.Context,
    files: Annotated[
        int, typer.Option(min=1, help="How many log files to check, evenly chosen.")
    ] = 4,
    json: Json = False,
) -> None:
    """Compute Gram rows three ways and compare them, bit for bit.

    By the SQL statement, by float64 matrix products on blocks in which every partial sum is an
    exact integer, and (for one drive of each file) by Python integers; and with the stored rows.
    """
    with progress("check", "files") as advance:
        report = check_grams(context.obj, files, advance)
    if json:
        print_json(asdict(report))
    else:
        wide = [f"{report.wide_drives}"]
        print_table(
            "",
            ["way", "drives", "equal"],
            [
                ["SQL against stored Gram rows", f"{report.drives}", "yes"],
                ["SQL against float64 blocks", f"{report.drives}", "yes"],
                ["SQL against Python integers", f"{report.drives_by_integers}", "yes"],
                *(
                    [[f"SQL against the kernel: {', '.join(report.wide_sets)}", *wide, "yes"]]
                    if report.wide_sets
                    else []
                ),
            ],
        )
