"""Reducing logs to Gram rows: the commands gram and check."""

from concurrent.futures import Executor
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features as known_features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.completing import complete_feature_set
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.record_runs import record_run
from fleet_slip.cli.workers import Cluster
from fleet_slip.grams.rows.statement import gram_statement
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.grams.rows.gram_job import GramReport

ALL_SETS = "all"
"""Instead of the name of a feature set: every one."""


@record_run
def gram(
    context: typer.Context,
    feature_set: Annotated[
        str,
        typer.Option(
            "--features",
            autocompletion=complete_feature_set,
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

    Example: **fleet-slip gram --features windows**
    """
    names = (PLAIN, *known_features().sets) if feature_set == ALL_SETS else (feature_set,)
    if sql:
        for name in names:
            typer.echo(gram_statement(catalogue(), name))
        return
    fleet: Fleet = context.obj
    with open_workers(fleet.root, cluster) as executor:
        if cohort:  # which files have its drives is known from the logged signals' Gram rows
            _run_gram(fleet, executor, PLAIN, None)
        reports = [_run_gram(fleet, executor, name, cohort) for name in names]
    if json:
        print_json(reports if feature_set == ALL_SETS else reports[0])
        return
    for report in reports:
        _say_gram(report)
    if not (any(one.gram_rows for one in reports) or fleet.warehouse.logs.snapshot().files):
        say(f"{fleet.root}: there are no logs yet. They come with: fleet-slip run, or ingest")


def _run_gram(
    fleet: Fleet, executor: Executor, feature_set: str, cohort: str | None
) -> "GramReport":
    with progress(f"gram {feature_set}", "rows", executor) as show:
        return fleet.gram(feature_set, cohort=cohort, workers=executor, progress=show)


def _say_gram(report: "GramReport") -> None:
    if report.changed:
        say(
            f"gram {report.feature_set}: {number_of(report.files_read, 'new file')}, "
            f"{number_of(report.rows_read, 'row')} "
            f"read, {number_of(report.files_dropped, 'file')} dropped; "
            f"{number_of(report.gram_rows, 'Gram row')} in all"
        )
        if report.received_dropped:
            say(
                f"{number_of(report.received_dropped, 'Gram row')} that cars had sent dropped: the "
                "logs of the same drives are here now"
            )
    else:
        say(
            f"gram {report.feature_set}: nothing to do, {number_of(report.gram_rows, 'Gram row')} "
            "in all are "
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

    Example: **fleet-slip check**
    """
    with progress("check", "files") as show:
        report = context.obj.check(files, progress=show)
    if json:
        print_json(report)
    else:
        ways = {
            "SQL against stored Gram rows": report.drives,
            "SQL against float64 blocks": report.drives,
            "SQL against Python integers": report.drives_by_integers,
        }
        if report.wide_sets:
            ways[f"SQL against the kernel: {', '.join(report.wide_sets)}"] = report.wide_drives
        rows = [[way, f"{drives}", "yes"] for way, drives in ways.items()]
        print_table("", ["way", "drives", "equal"], rows)
