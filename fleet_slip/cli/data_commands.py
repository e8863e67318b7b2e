"""Commands for data and columns: simulate, ingest, mapping, gram, features."""

import logging
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Context, Option

from fleet_slip.api.calls import open_workers
from fleet_slip.base import pluralize
from fleet_slip.cli import options as opt
from fleet_slip.cli.options import fleet_of
from fleet_slip.cli.output import (
    print_answer,
    print_json,
    print_parts,
    print_table,
    print_text,
    progress,
    say,
    write_text,
)
from fleet_slip.config import read_named_file
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.rendering import TextTable
from fleet_slip.resources import folder

if TYPE_CHECKING:
    from fleet_slip.catalog.signals import SignalCatalog
    from fleet_slip.grams.update import GramReport
    from fleet_slip.ingest.draft import Draft
    from fleet_slip.ingest.logs import IngestReport

ALL_SETS = "all"
"""Name that stands for every feature set."""


def simulate(
    context: Context,
    campaign: Annotated[str, Argument(help="Campaign of configs/campaigns, or a TOML file.")],
    days: opt.CampaignDays = None,
    through: opt.Through = None,
    engine: Annotated[
        Literal["kernel", "highway-env"],
        Option(help="The compiled kernel, or highway-env's vehicle: slower, the same logs."),
    ] = "kernel",
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    json: opt.Json = False,
) -> None:
    """Simulate the missing drives of a campaign and write them to the logs.

    Example: fleet-slip simulate waterford --days 2
    """
    with progress(f"simulate {campaign}") as show:
        report = fleet_of(context).simulate(
            campaign,
            days=days,
            through=through,
            engine=engine,
            workers=cluster or threads,
            progress=show,
        )
    print_answer(report, json)


def ingest(
    context: Context,
    files: Annotated[list[str], Argument(help="Log files or folders.")],
    mapping: Annotated[
        str | None,
        Option(
            help="Mapping of configs/mappings, or a TOML file. Without it, the files are tables of "
            "Gram rows."
        ),
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Store nothing; exit code 10 if anything looks wrong.")
    ] = False,
    replace: Annotated[
        bool,
        Option(
            "--replace",
            help="Replace the drives of the same recordings, such as after a correction of the "
            "mapping.",
        ),
    ] = False,
    cluster: opt.Cluster = None,
    json: opt.Json = False,
) -> None:
    """Bring measured logs into the data root through a mapping of columns, units and axes.

    Formats: CSV, Parquet, MDF, MATLAB, CAN traces, MCAP, TDMS, VBO. Of folders, files that were
    ingested before are skipped.

    Without a mapping, files are tables of Gram rows that cars computed on board (docs/export.md).

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"

    Example: fleet-slip ingest drive.csv --mapping logger.toml --dry-run
    """
    fleet = fleet_of(context)
    if mapping is None:
        if dry_run or replace:
            raise UsageError("give --mapping: only tables of Gram rows (docs/export.md) have none.")
        print_answer([fleet.import_onboard_grams(file) for file in files], json)
        return
    if dry_run:
        previews = fleet.preview(files, mapping)
        print_answer(previews, json)
        if suspicions := sum(len(preview.alarms) for preview in previews):
            raise AlarmError(
                f"{pluralize(suspicions, 'suspicion')}, see above. Nothing was stored."
            )
        return

    from fleet_slip.ingest.log_files import names_several

    folders = any(map(names_several, files))
    warn_of_passed_over(files)
    warned: set[tuple[str, tuple[str, ...]]] = set()

    def print_report(report: "IngestReport") -> None:
        if not (json or folders):
            say(summarize_ingest(report.file, [report]))
        for suspicion in report.suspicions:
            if (suspicion.kind, suspicion.signals) not in warned:
                warned.add((suspicion.kind, suspicion.signals))
                say(f"{report.file}: looks wrong: {suspicion}", logging.WARNING)

    with progress("ingest") as show:
        reports = fleet.ingest(
            files,
            mapping,
            replace="all" if replace else "no",
            workers=cluster,
            on_report=print_report,
            progress=show,
        )
    if json:
        print_json(reports)
    elif folders:
        new = sum(report.new for report in reports)
        say(summarize_ingest(pluralize(new, "new file"), reports) if new else "nothing new")
    if alarms := [f"{report.file}: {alarm}" for report in reports for alarm in report.alarms]:
        raise AlarmError(
            f"{alarms[0]} Its rows are stored. Correct the mapping and repeat the command with "
            "--replace."
        )


def warn_of_passed_over(files: Sequence[str]) -> None:
    """Print the number of files of folders that are not logs, and some names."""
    from fleet_slip.ingest.log_files import find_logs

    if passed_over := find_logs(files).describe_passed_over():
        say(passed_over, logging.WARNING)


def summarize_ingest(subject: str, reports: "Sequence[IngestReport]") -> str:
    """Summarise the reports of files in a sentence."""
    from fleet_slip.warehouse.erasure_log import skipped_drives

    new = [report for report in reports if report.new or report.drives_forgotten]
    if not new:
        return f"{subject}: nothing to do, it was ingested before"
    rejected: Counter[str] = Counter()
    for report in new:
        rejected.update(report.counts.quarantined)
    reasons = ", ".join(f"{rows:,} {reason}" for reason, rows in rejected.items())
    excluded = sum(report.counts.rows_left_out for report in new)
    ticks, drives = (sum(getattr(r.counts, name) for r in new) for name in ("ticks", "drives"))
    text = f"{subject}: {pluralize(ticks, 'row')} in {pluralize(drives, 'drive')}"
    if excluded:
        text += f"; excluded by the mapping's conditions: {pluralize(excluded, 'row')}"
    if rejected:
        text += f"; in quarantine: {pluralize(rejected.total(), 'row')} ({reasons})"
    if replaced := sum(report.drives_replaced for report in new):
        text += f"; {pluralize(replaced, 'drive')} replaced"
    return text + skipped_drives(sum(report.drives_forgotten for report in new))


# Mappings.

mapping_app = typer.Typer(no_args_is_help=True)


@mapping_app.callback()
def mapping() -> None:
    """Draft and list mappings, which describe the columns, units and axes of logs.

    Example: fleet-slip mapping suggest drive.mf4
    """


@mapping_app.command()
def suggest(
    context: Context,
    file: Annotated[str, Argument(help="A measured log, or the folder of a lake of CAN messages.")],
    output: Annotated[Path | None, Option(help="File for the draft. Default: stdout.")] = None,
    can: Annotated[Path | None, Option(help="Database of a CAN trace: DBC, KCD or SYM.")] = None,
    plot: Annotated[
        Path | None, Option(help="Page to write, .html: the mapped signals in SI units.")
    ] = None,
    json: opt.Json = False,
) -> None:
    """List the channels of a measured log, and draft a mapping for it.

    Channels are guessed by name, unit and values. Each guess has its reason as a comment; check it.
    A dry run of ingest shows signs, and which wheel is which.

    Example: fleet-slip mapping suggest drive.mf4
    """
    if output is not None and output.exists():
        raise UsageError(f"{output} exists. Choose another name, or remove it.")
    catalog = fleet_of(context).warehouse.catalog.signals
    from fleet_slip.ingest.draft import name_of, write_draft

    draft, name = _draft(catalog, file, can), name_of(Path(file).stem)
    text = write_draft(draft, name)
    sure = {name: guess for name, guess in draft.guesses.items() if not guess.is_doubtful}
    signals = {guess.column: name for name, guess in sure.items()}
    channels = [
        {
            "channel": profile.channel.name,
            "unit": profile.channel.unit,
            "rate_hz": profile.rate_hz or draft.time.rate_hz,
            "least": profile.range[0] if profile.is_number else None,
            "most": profile.range[1] if profile.is_number else None,
            "missing": profile.missing if profile.is_number else None,
            "texts": profile.texts,
            "signal": signals.get(profile.channel.name),
        }
        for profile in draft.profile.profiles
    ]
    if json:
        print_json({"channels": channels, "mapping": text})
    else:
        header = "channel|unit|guess|Hz|least|most|missing"
        row = "{channel}|{unit}|{signal}|{rate_hz:.4g}|{least:.4g}|{most:.4g}|{missing:.1%}"
        title = f"{file}: {len(channels)} channels"
        print_parts([TextTable(title, header, channels, row, text_columns=3)])
    if plot is not None:
        from fleet_slip.ingest.signal_page import write_signal_page

        write_text(plot, write_signal_page(catalog, draft), ": the mapped signals")
    if output is not None:
        text = write_draft(draft, name, _ask_for_open(draft))
        write_text(output, text, ": a draft of a mapping")
    elif not json:
        print_text("\n" + text)


@mapping_app.command(name="list")
def list_mappings(context: Context, json: opt.Json = False) -> None:
    """List the mappings of configs/mappings.

    Example: fleet-slip mapping list
    """
    configs = fleet_of(context).warehouse.configs
    files = {name: str(configs.find("mappings", name)) for name in configs.names("mappings")}
    print_table(files, json, TextTable("", "mapping|file", files.items(), text_columns=2))


def _ask_for_open(draft: "Draft") -> dict[str, str]:
    """Ask for the open keys of a draft on a terminal; return the answers."""
    answers: dict[str, str] = {}
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return answers
    say("Some keys of the draft are open. An empty answer leaves a key open.")
    for key, units in draft.open_keys().items():
        choices = f" in {' or '.join(units)}" if units else ""
        try:
            answer = typer.prompt(f"{key}{choices}", default="", show_default=False, err=True)
        except typer.Abort as error:
            if isinstance(error.__context__, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            say("")
            break  # the input has ended
        answers[key] = answer.strip()
    return answers


def _draft(signals: "SignalCatalog", file: str, can: Path | None) -> "Draft":
    """Return the draft of a mapping for a log."""
    from fleet_slip.ingest.draft import draft_mapping
    from fleet_slip.ingest.formats.file_formats import CanBus, read_can_database
    from fleet_slip.ingest.log_files import FileGroup, find_logs
    from fleet_slip.ingest.profile import profile_file

    bus = read_can_database(CanBus(database=str(can.absolute())), can.parent) if can else None
    logs = find_logs([file])
    groups = [log for log in logs if isinstance(log, FileGroup)]
    if len(logs) > 1 and len(groups) < len(logs):
        raise UsageError(f"{file}: {len(logs):,} logs. Give one of them.")
    # The first session of a lake that has all messages.
    log = max(groups, key=lambda group: len(group.members)) if groups else logs[0]
    return draft_mapping(signals, log, profile_file(log, bus))


# Gram rows.


def gram(
    context: Context,
    features: Annotated[
        str,
        Option(help="Feature set of configs/features.toml, or all; signals is the logged signals."),
    ] = "signals",
    cohort: Annotated[
        str | None,
        Option(help="SQL predicate on the view drives: read only log files with such a drive."),
    ] = None,
    threads: opt.Threads = None,
    cluster: opt.Cluster = None,
    sql: Annotated[bool, Option("--sql", help="Print the SQL statement; compute nothing.")] = False,
    json: opt.Json = False,
) -> None:
    """Reduce new log files to Gram rows, and drop the Gram rows of deleted files.

    The first run for a feature set reads all logs; later runs read new files. With --cohort, only
    log files with such a drive are read.

    Every set: fleet-slip gram --features all

    Example: fleet-slip gram --features windows
    """
    fleet = fleet_of(context)
    names = fleet.warehouse.feature_sets() if features == ALL_SETS else (features,)
    if sql:
        from fleet_slip.grams.compute import gram_statement, has_statement

        catalog = fleet.warehouse.catalog
        for name in names:
            if features != ALL_SETS or has_statement(catalog, name):
                typer.echo(gram_statement(catalog, name))
        return
    reports: list[GramReport] = []
    with open_workers(fleet.root, cluster or threads) as executor:
        if cohort:  # the Gram rows of the logged signals tell which files have its drives
            with progress("gram signals") as show:
                fleet.gram(workers=executor, progress=show)
        for name in names:
            with progress(f"gram {name}") as show:
                reports.append(fleet.gram(name, cohort=cohort, workers=executor, progress=show))
    print_answer(reports if features == ALL_SETS else reports[0], json)


# Features, feature sets and config files.


def features(
    context: Context,
    sets: Annotated[
        bool, Option("--sets", help="List the feature sets instead of the features.")
    ] = False,
    sql: Annotated[
        str | None,
        Option(
            help="Print the query over log_counts that computes this feature, window or factor."
        ),
    ] = None,
    files: Annotated[
        bool, Option("--files", help="List the config files in use, and their folders.")
    ] = False,
    everything: opt.All = False,
    json: opt.Json = False,
) -> None:
    """List the features and feature sets of configs/features.toml.

    Features are integer functions of the logged counts, such as yaw rate over speed. Compute the
    Gram rows of a set with: fleet-slip gram --features NAME, then use it with: fleet-slip
    select --features NAME

    Example: fleet-slip features --sql ay_mean_16
    """
    from fleet_slip.catalog.features import PLAIN

    catalog = fleet_of(context).warehouse.catalog
    if files:
        configs = catalog.configs
        overlay, in_use = configs.folder, configs.files()
        places = {
            name: {
                "from": "own" if overlay and str(file).startswith(str(overlay)) else "shipped",
                "path": str(file),
            }
            for name, file in in_use.items()
            if read_named_file(file)
        }
        heading = f"own configs: {overlay or 'none'}\nshipped ones: {folder('configs')}"
        table = TextTable(heading, "file|from", places.items(), "{0}|{1[from]}", text_columns=2)
        print_table(places, json, table)
        return
    feature_sets = {name: catalog.feature_set(name) for name in (PLAIN, *catalog.sets)}
    if sql is not None:
        from fleet_slip.columns.column_sql import column_query

        typer.echo(column_query(catalog, sql))
    elif json:
        print_json(
            {
                "windows": {
                    name: column.model_dump(mode="json")
                    for name, column in catalog.time_columns.items()
                },
                "features": {
                    name: {**feature.model_dump(mode="json"), "sql": feature.sql}
                    for name, feature in catalog.features.items()
                },
                "sets": {
                    name: {
                        "identity": catalog.identity(name),
                        **feature_set.model_dump(),
                        "block_s": feature_set.block_s and float(feature_set.block_s),
                    }
                    for name, feature_set in feature_sets.items()
                },
            }
        )
    elif sets:
        row = "{0}|{1.inputs}|{1.description}"
        print_parts(
            [TextTable("", "set|columns|description", feature_sets.items(), row, text_columns=3)]
        )
    else:
        columns: dict[str, Any] = dict(catalog.features)
        if everything:
            columns |= catalog.time_columns
        header, row = "column|unit|scale|description", "{0}|{1.unit}|{1.scale}|{1.description}"
        print_parts([TextTable("", header, columns.items(), row, text_columns=4)])
        if not everything:
            say(f"and {pluralize(len(catalog.time_columns), 'column')} over time: --all")
