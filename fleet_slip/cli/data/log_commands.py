"""Commands that fill the warehouse: simulate and ingest."""

import logging
import sys
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
from fleet_slip.cli.recorded import record_run
from fleet_slip.cli.workers import Cluster, Threads
from fleet_slip.dates import last_day
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.runs.log import recording
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.ingest.drafting.preview import Preview
    from fleet_slip.ingest.landing.ingest_job import IngestReport
    from fleet_slip.simulation.job import SimulationReport

CampaignName = Annotated[
    str,
    typer.Argument(
        help="A campaign of configs/campaigns, or the path of a TOML file.",
        autocompletion=complete_config("campaigns"),
    ),
]
Through = Annotated[str | None, option(RunRequest, "through")]
Days = Annotated[int | None, option(RunRequest, "days")]


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
        f"{name} {getattr(seconds, name) / seconds.tasks:.0%}"
        for name in ("simulate", "encode", "write")
    )
    return (
        f"{seconds.elapsed:.1f} s, {report.rows / seconds.elapsed:,.0f} rows/s: "
        f"{seconds.tasks / seconds.elapsed:.1f} workers busy ({shares}), commits "
        f"{seconds.commit:.1f} s"
    )


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

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"

    Example: **fleet-slip ingest drive.csv --mapping logger.toml --dry-run**
    """
    from fleet_slip.ingest.logs.log_files import names_several  # noqa: PLC0415 - takes a while

    fleet: Fleet = context.obj
    if undo is not None:
        _take_back(fleet, undo, json, alone=not (files or mapping or replace or dry_run or as_one))
        return
    if not files or mapping is None:
        raise UsageError("give files and --mapping; or --undo alone, to take drives out again.")
    if plot is not None and not (dry_run and len(files) == 1):
        raise UsageError("--plot draws one file, with --dry-run.")
    if dry_run:
        _show_previews(fleet.preview(files, mapping, as_one=as_one), plot, json)
        return
    folders = any(map(names_several, files)) and not as_one
    each = Remarks(quiet=json or folders)
    with (
        recording(fleet.root, "ingest", sys.argv[1:]),
        progress(*(("ingest", "files") if folders else ("read", "rows"))) as show,
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


def _require_sound(reports: "list[IngestReport]") -> None:
    """Raise `AlarmError` for much that was refused, and for whatever looks wrong and does harm."""
    from fleet_slip.ingest.drives.suspicion import (  # noqa: PLC0415 - takes a while
        FEWEST_REFUSED,
        LARGEST_REFUSED,
    )

    for report in reports:
        refused, read = sum(report.counts.quarantined.values()), report.counts.rows_read
        if report.new and refused > max(read * LARGEST_REFUSED, FEWEST_REFUSED):
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
    say(
        f"{number_of(drives, 'drive')} taken out, Gram rows and all; to land again, their files "
        "must be given again"
    )


def _summed_up(reports: "list[IngestReport]") -> str:
    new = [report for report in reports if report.new]
    if not new:
        return "nothing new"
    held = sum(sum(report.counts.quarantined.values()) for report in new)
    return (
        f"{number_of(len(new), 'new file')}: {number_of(sum(r.counts.ticks for r in new), 'row')} "
        f"in {number_of(sum(r.counts.drives for r in new), 'drive')}"
        + (f"; in quarantine: {number_of(held, 'row')}" if held else "")
        + _in_place_of(sum(report.drives_replaced for report in new))
        + _left_out(sum(report.drives_forgotten for report in new))
    )


class Remarks:
    """Says what became of each file, and once what looks wrong in several."""

    def __init__(self, *, quiet: bool) -> None:
        """Say of what became of files nothing, if it is said elsewhere."""
        self._quiet = quiet
        self._told: set[tuple[str, tuple[str, ...]]] = set()

    def __call__(self, report: "IngestReport") -> None:
        """Say what is to be said of a file."""
        if not self._quiet:
            say(_ingested(report.as_dict()))
        for names in report.look_alikes:
            say(
                f"{report.file}: the names {' and '.join(map(ascii, names))} look the same and "
                "count as several: they differ in their Unicode form. Write such names in one form "
                "in the files or the mapping, normally NFC.",
                logging.WARNING,
            )
        for one in report.suspicions:
            if (one.kind, one.signals) not in self._told:
                self._told.add((one.kind, one.signals))
                say(f"{report.file}: looks wrong: {one}", logging.WARNING)


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
        + _in_place_of(report["drives_replaced"])
        + _left_out(report["drives_forgotten"])
    )


def _in_place_of(drives: int) -> str:
    return f"; in place of {number_of(drives, 'drive')}" if drives else ""


def _show_previews(previews: "list[Preview]", plot: Path | None, json: bool) -> None:
    """Print previews, and draw the only one. Raises `AlarmError` if anything looks wrong."""
    if plot is not None:
        from fleet_slip.ingest.drafting.preview import draw_preview  # noqa: PLC0415 - draws

        draw_preview(previews[0], plot)
        say(f"drawn to {plot}")
    if json:
        print_json(previews)
    else:
        for preview in previews:
            _show_preview(preview)
    suspicions = sum(len(preview.suspicions) for preview in previews)
    if suspicions:
        raise AlarmError(
            f"{number_of(suspicions, 'thing')} to look at before ingesting. Nothing was stored."
        )


def _show_preview(preview: "Preview") -> None:
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
