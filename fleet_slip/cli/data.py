"""Commands that fill the warehouse: simulate, ingest, gram, check."""

import logging
import sys
from concurrent.futures import Executor
from contextlib import ExitStack
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features as known_features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.progress import progress
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.errors import UsageError
from fleet_slip.grams.statement import gram_statement
from fleet_slip.runs.log import recording
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.grams.job import GramReport
    from fleet_slip.ingest.job import IngestReport
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


def last_day(through: str | None) -> date | None:
    """Return the day that --through names. Raises `UsageError` for what is none."""
    if through is None or through == "today":
        return None if through is None else date.today()
    try:
        return date.fromisoformat(through)
    except ValueError:
        raise UsageError(
            f"--through {through}: not a date; write it as 2024-05-01, or today."
        ) from None


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

    fleet: Fleet = context.obj
    plan, last = load_campaign(campaign), last_day(through)
    with (
        open_workers(fleet.root, cluster or threads) as executor,
        progress(f"simulate {plan.name}", "rows", executor) as show,
    ):
        report = fleet.simulate(plan, days=days, through=last, workers=executor, progress=show)
    if json:
        print_json(report)
    elif report.changed:
        say(
            f"{plan.name}: {number_of(report.drives, 'drive')}, {number_of(report.rows, 'row')} in "
            f"{number_of(report.batches_written, 'file')}, "
            f"{report.size_bytes / max(report.rows, 1):.1f} bytes "
            f"a row{_left_out(report.drives_forgotten)}"
        )
        say(_where_the_time_went(report))
    else:
        chosen = plan.chosen_days(days, last)
        say(f"{plan.name}: nothing to do, {number_of(len(chosen), 'day')} done before")


def _left_out(drives: int) -> str:
    if not drives:
        return ""
    return (
        f"; {number_of(drives, 'drive')} left out, forgotten (fleet-slip forget --allow lets them "
        "come back)"
    )


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


def ingest(
    context: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Measured logs (CSV, Parquet, MDF, MATLAB, CAN traces, DuckDB), or folders of "
            "them, of which what is new is taken.",
            show_default=False,
        ),
    ],
    mapping: Annotated[
        str, typer.Option(help="A mapping of configs/mappings, or the path of a TOML file.")
    ],
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Store nothing; show what would be, and what looks wrong (exit 10)."
        ),
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(help="With --dry-run and one file, draw its longest drive: .png, .svg, .pdf."),
    ] = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Bring measured logs into the warehouse through a mapping of columns, units and axes.

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"
    """
    fleet: Fleet = context.obj
    if plot is not None and not (dry_run and len(files) == 1):
        raise UsageError("--plot draws one file, with --dry-run.")
    if dry_run:
        from fleet_slip.cli.previews import show_previews  # noqa: PLC0415 - draws, takes a while

        show_previews(fleet.preview(files, mapping), plot, json)
        return
    folders = any(file.is_dir() for file in files)
    each = _warn_of_look_alikes if json or folders else _say_ingested
    with recording(fleet.root, "ingest", sys.argv[1:]), ExitStack() as shown:
        show = shown.enter_context(progress("ingest", "files")) if folders else None
        reports = fleet.ingest(files, mapping, workers=cluster, each=each, progress=show)
    if json:
        print_json(reports)
    elif folders:
        say(_summed_up(reports))


def _summed_up(reports: "list[IngestReport]") -> str:
    new = [report for report in reports if report.new]
    if not new:
        return "nothing new"
    held = sum(sum(report.counts.quarantined.values()) for report in new)
    return (
        f"{number_of(len(new), 'new file')}: {number_of(sum(r.counts.ticks for r in new), 'row')} "
        f"in {number_of(sum(r.counts.drives for r in new), 'drive')}"
        + (f"; in quarantine: {number_of(held, 'row')}" if held else "")
        + _left_out(sum(report.drives_forgotten for report in new))
    )


def _say_ingested(report: "IngestReport") -> None:
    say(_ingested(report.as_dict()))
    _warn_of_look_alikes(report)


def _warn_of_look_alikes(report: "IngestReport") -> None:
    for names in report.look_alikes:
        say(_look_alike(report.file, names), logging.WARNING)


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
    left_out, held = report["rows_left_out"], report["rows_quarantined"]
    return (
        f"{report['file']}: {number_of(report['ticks'], 'row')} in "
        f"{number_of(report['drives'], 'drive')}"
        + (
            f"; not as the mapping's conditions ask: {number_of(left_out, 'row')}"
            if left_out
            else ""
        )
        + (f"; in quarantine: {number_of(held, 'row')} ({reasons})" if reasons else "")
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
    """
    with progress("check", "files") as show:
        report = context.obj.check(files, progress=show)
    if json:
        print_json(report)
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
