"""Commands that fill the warehouse: simulate and ingest."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.api.calls import open_workers
from fleet_slip.api.fleet import Fleet
from fleet_slip.api.requests import RunRequest
from fleet_slip.cli.completing import complete_config
from fleet_slip.cli.options import option
from fleet_slip.cli.output import Json, print_json, print_table, print_text, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.record_runs import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.dates import last_day
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.runs.log import recording
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.ingest.drafting.preview import Preview
    from fleet_slip.ingest.landing.ingest_job import IngestReport


@record_run
def simulate(
    context: typer.Context,
    campaign: Annotated[
        str,
        typer.Argument(
            help="A campaign of configs/campaigns, or the path of a TOML file.",
            autocompletion=complete_config("campaigns"),
        ),
    ],
    days: Annotated[int | None, option(RunRequest, "days")] = None,
    through: Annotated[str | None, option(RunRequest, "through")] = None,
    threads: Threads = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Simulate what is missing of a campaign and write it to the logs.

    Example: **fleet-slip simulate waterford --days 2**
    """
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
        written = (
            f"{plan.name}: {number_of(report.drives, 'drive')}, {number_of(report.rows, 'row')} in "
            f"{number_of(report.batches_written, 'file')}, "
            f"{report.size_bytes / max(report.rows, 1):.1f} bytes a row"
        )
        say(_joined(written, forgotten=report.drives_forgotten))
        seconds = report.seconds
        shares = ", ".join(
            f"{name} {getattr(seconds, name) / seconds.tasks:.0%}"
            for name in ("simulate", "encode", "write")
        )
        say(
            f"{seconds.elapsed:.1f} s, {report.rows / seconds.elapsed:,.0f} rows/s: "
            f"{seconds.tasks / seconds.elapsed:.1f} workers busy ({shares}), commits "
            f"{seconds.commit:.1f} s"
        )
    else:
        chosen = plan.chosen_days(days, last)
        say(f"{plan.name}: nothing to do, {number_of(len(chosen), 'day')} done before")


def _joined(*parts: str, replaced: int = 0, forgotten: int = 0) -> str:
    """Return one sentence of what there is to say, and of drives that gave way or did not come."""
    allow = "fleet-slip forget --allow lets them come back"
    parts += (
        f"in place of {number_of(replaced, 'drive')}" if replaced else "",
        f"{number_of(forgotten, 'drive')} left out, forgotten ({allow})" if forgotten else "",
    )
    return "; ".join(filter(None, parts))


def ingest(
    context: typer.Context,
    files: Annotated[
        list[str] | None,
        typer.Argument(
            help="Measured logs (CSV, Parquet, MDF, MATLAB, CAN traces, MCAP, DuckDB), or folders "
            "of them, of which what is new is taken; also s3://, gs:// and az://.",
            show_default=False,
        ),
    ] = None,
    mapping: Annotated[
        str | None,
        typer.Option(
            help="A mapping of configs/mappings, or the path of a TOML file: a mapping, or a list "
            "of them, each for files of its own.",
            show_default=False,
        ),
    ] = None,
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
    as_one: Annotated[
        bool, typer.Option("--as-one", help="The files of each folder are parts of one log.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Drives of the same recordings give way, as after a correction of the mapping.",
        ),
    ] = False,
    undo: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|MAPPING",
            help="Take out what came from a file or through a mapping, by its name, and no more.",
            show_default=False,
        ),
    ] = None,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Bring measured logs into the warehouse through a mapping of columns, units and axes.

    Without a mapping, files are tables of Gram rows that cars counted (docs/edge.md).

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"

    Example: **fleet-slip ingest drive.csv --mapping logger.toml --dry-run**
    """
    from fleet_slip.ingest.logs.log_files import names_several  # noqa: PLC0415 - takes a while

    fleet: Fleet = context.obj
    if undo is not None:
        _take_back(fleet, undo, json, alone=not (files or mapping or replace or dry_run or as_one))
        return
    if not files:
        raise UsageError("give files; or --undo alone, to take drives out again.")
    if mapping is None:
        _ingest_counted(fleet, files, json, alone=not (dry_run or as_one or replace or plot))
        return
    if plot is not None and not (dry_run and len(files) == 1):
        raise UsageError("--plot draws one file, with --dry-run.")
    if dry_run:
        _show_previews(fleet.preview(files, mapping, as_one=as_one), plot, json)
        return
    folders = any(map(names_several, files)) and not as_one
    each = remarks(quiet=json or folders)
    with (
        recording(fleet.root, "ingest", sys.argv[1:]),
        progress(*(("ingest", "files") if folders else ("read", "bytes"))) as show,
    ):
        reports = fleet.ingest(
            files,
            mapping,
            as_one=as_one,
            replace="all" if replace else "no",
            workers=cluster,
            each=each,
            progress=show,
        )
    if json:
        print_json(reports)
    elif folders:
        say(_summed_up(reports))
    _require_sound(reports)


def _ingest_counted(fleet: Fleet, files: list[str], json: bool, *, alone: bool) -> None:
    """Bring in tables of Gram rows that cars counted."""
    if not alone:
        raise UsageError("give --mapping: without it files are tables of Gram rows (docs/edge.md).")
    with recording(fleet.root, "ingest", sys.argv[1:]):
        reports = [fleet.ingest_counted(file) for file in files]
    if json:
        print_json([vars(report) for report in reports])
        return
    for one in reports:
        if one.new:
            what = f"{number_of(one.gram_rows, 'Gram row')} of {number_of(one.drives, 'drive')}"
            say(f"{one.file}: {what}, {number_of(one.rows, 'row')}")
        else:
            say(f"{one.file}: nothing to do, it was ingested before")


def _require_sound(reports: "list[IngestReport]") -> None:
    """Raise `AlarmError` for much that was refused, and for whatever looks wrong and does harm."""
    from fleet_slip.ingest.drives import file_suspicion  # noqa: PLC0415 - takes a while

    for report in reports:
        refused, read = sum(report.counts.quarantined.values()), report.counts.rows_read
        many = max(read * file_suspicion.LARGEST_REFUSED, file_suspicion.FEWEST_REFUSED)
        if report.new and refused > many:
            raise AlarmError(
                f"{report.file}: {refused:,} of {number_of(read, 'row')} were refused. See: "
                'fleet-slip sql "FROM quarantine". Correct the mapping and give the command again '
                "with --replace."
            )
        for one in report.suspicions:
            if one.kind != "scale":
                raise AlarmError(
                    f"{report.file}: {one} Its rows are in. Give the command again with --replace "
                    "when the mapping is right."
                )


def _take_back(fleet: Fleet, what: str, json: bool, *, alone: bool) -> None:
    """Take out what came from a file or through a mapping, and say how many drives."""
    if not alone:
        raise UsageError("--undo takes out and brings nothing in: give it alone.")
    with recording(fleet.root, "ingest", sys.argv[1:]):
        drives = fleet.take_back(what)
    if json:
        print_json({"drives_taken_out": drives})
        return
    if not drives:
        say(
            f"nothing to undo: no drive of the logs came from a file {what!r}, or through a "
            'mapping of this name. See: fleet-slip sql "SELECT drive_id, source_file FROM drives"'
        )
        return
    say(
        f"{number_of(drives, 'drive')} taken out, Gram rows and all; to land again, their files "
        "must be given again"
    )


def _summed_up(reports: "list[IngestReport]") -> str:
    new = [report for report in reports if report.new]
    if not new:
        return "nothing new"
    held = sum(sum(report.counts.quarantined.values()) for report in new)
    return _joined(
        f"{number_of(len(new), 'new file')}: {number_of(sum(r.counts.ticks for r in new), 'row')} "
        f"in {number_of(sum(r.counts.drives for r in new), 'drive')}",
        f"in quarantine: {number_of(held, 'row')}" if held else "",
        replaced=sum(report.drives_replaced for report in new),
        forgotten=sum(report.drives_forgotten for report in new),
    )


def remarks(*, quiet: bool) -> "Callable[[IngestReport], None]":
    """Return what says what became of a file, unless `quiet`, and once what looks wrong in some."""
    told: set[tuple[str, tuple[str, ...]]] = set()

    def tell(report: "IngestReport") -> None:
        if not quiet:
            say(_ingested(report.as_dict()))
        for names in report.look_alikes:
            say(
                f"{report.file}: the names {' and '.join(map(ascii, names))} look the same and "
                "count as several: they differ in their Unicode form. Write such names in one form "
                "in the files or the mapping, normally NFC.",
                logging.WARNING,
            )
        for one in report.suspicions:
            if (one.kind, one.signals) not in told:
                told.add((one.kind, one.signals))
                say(f"{report.file}: looks wrong: {one}", logging.WARNING)

    return tell


def _ingested(report: dict[str, Any]) -> str:
    if not report["new"] and not report["drives_forgotten"]:
        return f"{report['file']}: nothing to do, it was ingested before"
    reasons = ", ".join(f"{n:,} {reason}" for reason, n in report["quarantined"].items())
    left_out, held = report["rows_left_out"], report["rows_quarantined"]
    return _joined(
        f"{report['file']}: {number_of(report['ticks'], 'row')} in "
        f"{number_of(report['drives'], 'drive')}",
        f"not as the mapping's conditions ask: {number_of(left_out, 'row')}" if left_out else "",
        f"in quarantine: {number_of(held, 'row')} ({reasons})" if reasons else "",
        replaced=report["drives_replaced"],
        forgotten=report["drives_forgotten"],
    )


def _show_previews(previews: "list[Preview]", plot: Path | None, json: bool) -> None:
    """Print previews, and draw the only one. Raises `AlarmError` if anything looks wrong."""
    if plot is not None:
        from fleet_slip.ingest.drafting.preview import draw_preview  # noqa: PLC0415 - draws

        draw_preview(previews[0], plot)
        say(f"drawn to {plot}")
    if json:
        print_json(previews)
    for preview in () if json else previews:
        counts = preview.counts
        rejected = ", ".join(f"{n:,} {reason}" for reason, n in counts.quarantined.items())
        print_table(
            f"{preview.file}: {number_of(counts.rows_read, 'row')}; left out by conditions "
            f"{counts.rows_left_out:,}; rejected {sum(counts.quarantined.values()):,}"
            f"{f' ({rejected})' if rejected else ''}; {number_of(counts.drives, 'drive')} of "
            f"{number_of(counts.ticks, 'tick')}",
            ["signal", "unit", "least", "most", "missing"],
            [
                [one.signal, one.unit, f"{one.low:.4g}", f"{one.high:.4g}", f"{one.missing:.1%}"]
                for one in preview.ranges
            ],
            left=2,
        )
        for suspicion in preview.suspicions:
            print_text(f"looks wrong: {suspicion}")
    if suspicions := sum(len(preview.suspicions) for preview in previews):
        raise AlarmError(
            f"{number_of(suspicions, 'thing')} to look at before ingesting. Nothing was stored."
        )
