"""Commands that fill the warehouse: simulate and ingest."""

import logging
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.cli.options import Cluster, command
from fleet_slip.cli.output import Json, print_json, print_parts, say
from fleet_slip.cli.progress import progress
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.rendering import TextTable
from fleet_slip.storage.storage_errors import storage_errors
from fleet_slip.warehouse.erasure_log import skipped_drives

if TYPE_CHECKING:
    from fleet_slip.ingest.draft import Draft
    from fleet_slip.ingest.load import IngestReport, Preview


@command(Fleet.simulate, arguments=["campaign"], progress="simulate {campaign}")
def simulate() -> None:
    """Simulate what is missing of a campaign and write it to the logs.

    Example: fleet-slip simulate waterford --days 2
    """


@command(Fleet.ingest, without=["workers"])
def ingest(
    fleet: Fleet,
    files: Annotated[
        list[str],
        typer.Argument(
            help="Measured logs (CSV, Parquet, MDF, MATLAB, CAN traces, MCAP, TDMS, VBO), or "
            "folders of them, of which what is new is taken.",
            show_default=False,
        ),
    ],
    mapping: Annotated[
        str | None,
        typer.Option(
            help="A mapping of configs/mappings, or the path of a TOML file.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Store nothing; show what would be, and what looks wrong (exit 10)."
        ),
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Drives of the same recordings give way, as after a correction of the mapping.",
        ),
    ] = False,
    cluster: Cluster = None,
    json: Json = False,
) -> None:
    """Bring measured logs into the warehouse through a mapping of columns, units and axes.

    Without a mapping, files are tables of Gram rows that cars counted (docs/export.md).

    Rows that cannot be used go to the quarantine with a reason: fleet-slip sql "FROM quarantine"

    Example: fleet-slip ingest drive.csv --mapping logger.toml --dry-run
    """
    from fleet_slip.ingest.log_files import names_several  # noqa: PLC0415 - takes a while

    if mapping is None:
        if dry_run or replace:
            raise UsageError("give --mapping: only tables of Gram rows (docs/export.md) have none.")
        counted = [fleet.import_onboard_grams(file) for file in files]
        if json:
            print_json(counted)
        else:
            print_parts(part for one in counted for part in one.parts())
    elif dry_run:
        _show_previews(fleet.preview(files, mapping), json)
    else:
        folders = any(map(names_several, files))
        seen: set[tuple[str, tuple[str, ...]]] = set()

        def tell(report: "IngestReport") -> None:
            if not (json or folders):
                say(_ingested(report.file, [report]))
            for one in report.suspicions:
                if (one.kind, one.signals) not in seen:
                    seen.add((one.kind, one.signals))
                    say(f"{report.file}: looks wrong: {one}", logging.WARNING)

        with progress("ingest") as show:
            reports = fleet.ingest(
                files,
                mapping,
                replace="all" if replace else "no",
                workers=cluster,
                each=tell,
                progress=show,
            )
        if json:
            print_json(reports)
        elif folders:
            new = sum(report.new for report in reports)
            say(_ingested(pluralize(new, "new file"), reports) if new else "nothing new")
        _require_sound(reports)


def _require_sound(reports: "list[IngestReport]") -> None:
    """Raise `AlarmError` for whatever looks wrong and does harm."""
    for report in reports:
        for one in report.alarms:
            raise AlarmError(
                f"{report.file}: {one} Its rows are stored. Correct the mapping and repeat the "
                "command with --replace."
            )


def _ingested(what: str, reports: "Sequence[IngestReport]") -> str:
    """Return a sentence on what came of files."""
    new = [report for report in reports if report.new or report.drives_forgotten]
    if not new:
        return f"{what}: nothing to do, it was ingested before"
    refused: Counter[str] = Counter()
    for report in new:
        refused.update(report.counts.quarantined)
    reasons = ", ".join(f"{rows:,} {reason}" for reason, rows in refused.items())
    left_out = sum(report.counts.rows_left_out for report in new)
    ticks, drives = (sum(getattr(one.counts, name) for one in new) for name in ("ticks", "drives"))
    text = f"{what}: {pluralize(ticks, 'row')} in {pluralize(drives, 'drive')}"
    if left_out:
        text += f"; excluded by the mapping's conditions: {pluralize(left_out, 'row')}"
    if refused:
        text += f"; in quarantine: {pluralize(refused.total(), 'row')} ({reasons})"
    if replaced := sum(report.drives_replaced for report in new):
        text += f"; {pluralize(replaced, 'drive')} replaced"
    return text + skipped_drives(sum(report.drives_forgotten for report in new))


def _show_previews(previews: "list[Preview]", json: bool) -> None:
    """Print previews. Raises `AlarmError` if anything looks wrong."""
    if json:
        print_json(previews)
    else:
        for preview in previews:
            print_parts(preview.parts())
    if suspicions := sum(len(preview.alarms) for preview in previews):
        raise AlarmError(f"{pluralize(suspicions, 'suspicion')}, see above. Nothing was stored.")


# The command that helps to write mappings.


def mapping(
    context: typer.Context,
    _action: Annotated[Literal["suggest"], typer.Argument(metavar="suggest", show_default=False)],
    file: Annotated[str, typer.Argument(help="A measured log.", show_default=False)],
    output: Annotated[
        Path | None, typer.Option(help="Write the draft to this file instead of printing it.")
    ] = None,
    can: Annotated[
        Path | None, typer.Option(help="Of a CAN trace, its database: DBC, KCD or SYM.")
    ] = None,
    json: Json = False,
) -> None:
    """List what is in a measured log, and draft a mapping for it.

    Channels are guessed by name, unit and values. Each guess has its reason as a comment, for a
    person to check; signs, and which wheel is which, a dry run of the ingest shows.

    Example: fleet-slip mapping suggest drive.mf4
    """
    if output is not None and output.exists():
        raise UsageError(f"{output} exists. Choose another name, or remove it.")
    draft, text = _draft(context.obj().warehouse.catalog.signals, file, can)
    signals = {guess.profile.channel.name: name for name, guess in draft.guesses.items()}
    channels = [
        {
            "channel": one.channel.name,
            "unit": one.channel.unit,
            "rate_hz": one.rate_hz or draft.time.rate_hz,
            "least": one.range[0] if one.is_number else None,
            "most": one.range[1] if one.is_number else None,
            "missing": one.missing if one.is_number else None,
            "texts": one.texts,
            "signal": signals.get(one.channel.name),
        }
        for one in draft.profile.profiles
    ]
    if json:
        print_json({"channels": channels, "mapping": text})
    else:
        header = "channel|unit|guess|Hz|least|most|missing"
        row = "{channel}|{unit}|{signal}|{rate_hz:.4g}|{least:.4g}|{most:.4g}|{missing:.1%}"
        title = f"{file}: {len(channels)} channels"
        print_parts([TextTable(title, header, channels, row, left=3)])
    if output is not None:
        with storage_errors(output):
            output.write_text(text, encoding="utf-8")
        say(f"draft written to {output}")
    elif not json:
        print_parts(["\n" + text])


def _draft(signals: SignalCatalog, file: str, can: Path | None) -> "tuple[Draft, str]":
    """Return what a log suggests, and that as a mapping."""
    from fleet_slip.ingest.draft import draft_mapping, name_of, write_draft  # noqa: PLC0415 - takes a while
    from fleet_slip.ingest.formats.can import CanBus, read_can_database  # noqa: PLC0415
    from fleet_slip.ingest.log_files import find_logs  # noqa: PLC0415
    from fleet_slip.ingest.profile import profile_file  # noqa: PLC0415

    bus = read_can_database(CanBus(database=str(can.absolute())), can.parent) if can else None
    logs = find_logs([file])
    if len(logs) > 1:
        raise UsageError(f"{file}: {len(logs):,} logs. Give one of them.")
    draft = draft_mapping(signals, logs[0], profile_file(logs[0], bus))
    return draft, write_draft(draft, name_of(logs[0].stem))
