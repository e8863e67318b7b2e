"""The command that helps to write mappings."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.cli.output import Json, print_json, print_table, print_text, say
from fleet_slip.errors import UsageError
from fleet_slip.files.storage_errors import storage_errors

if TYPE_CHECKING:
    from fleet_slip.ingest.drafting.draft import Draft


class Action(StrEnum):
    """What to do."""

    SUGGEST = "suggest"


def mapping(
    _action: Annotated[Action, typer.Argument(metavar="suggest", show_default=False)],
    file: Annotated[
        str, typer.Argument(help="A measured log; also s3://, gs:// and az://.", show_default=False)
    ],
    output: Annotated[
        Path | None, typer.Option(help="Write the draft to this file instead of printing it.")
    ] = None,
    can: Annotated[
        Path | None, typer.Option(help="Of a CAN trace, its database: DBC, ARXML, KCD or SYM.")
    ] = None,
    table: Annotated[str | None, typer.Option(help="Of a DuckDB file, the table.")] = None,
    json: Json = False,
) -> None:
    """List what is in a measured log, and draft a mapping for it.

    Channels are guessed by name, unit and values; signs, and which wheel is which, by how the car
    moves. Each guess has its reason as a comment, for a person to check.

    Example: **fleet-slip mapping suggest drive.mf4**
    """
    from fleet_slip.ingest.drafting.draft import draft_mapping  # noqa: PLC0415
    from fleet_slip.ingest.drafting.draft_text import name_of, write_draft  # noqa: PLC0415
    from fleet_slip.ingest.drafting.profile import profile_file  # noqa: PLC0415
    from fleet_slip.ingest.formats.can.can_bus import CanBus, read_can_database  # noqa: PLC0415 - takes a while
    from fleet_slip.ingest.formats.duckdb_table import DuckdbRows  # noqa: PLC0415
    from fleet_slip.ingest.formats.reading import FileFormats  # noqa: PLC0415
    from fleet_slip.ingest.logs.log_files import find_logs, local_copy  # noqa: PLC0415

    if output is not None and output.exists():
        raise UsageError(f"{output}: it exists. Give another name, or remove it.")
    bus = read_can_database(CanBus(database=str(can.absolute())), can.parent) if can else None
    formats = FileFormats(can=bus, duckdb=DuckdbRows(table=table) if table else None)
    logs = find_logs([file])
    if len(logs) > 1:
        raise UsageError(f"{file}: {len(logs):,} logs. Give one of them.")
    with local_copy(logs[0]) as copy:
        draft = draft_mapping(copy, profile_file(copy, formats))
        text = write_draft(draft, name_of(copy.stem), file)
    if json:
        print_json({"channels": _channels(draft), "mapping": text})
    else:
        _show(file, draft)
    if output is not None:
        with storage_errors(output):
            output.write_text(text, encoding="utf-8")
        say(f"draft written to {output}")
    elif not json:
        print_text("\n" + text)


def _channels(draft: "Draft") -> list[dict[str, object]]:
    signals = {guess.profile.channel.name: name for name, guess in draft.guesses.items()}
    return [
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


def _show(file: str, draft: "Draft") -> None:
    rows = []
    for one in draft.profile.profiles:
        signal = next((n for n, g in draft.guesses.items() if g.profile is one), "")
        rate_hz = one.rate_hz or draft.time.rate_hz
        cells = [f"{value:.4g}" for value in one.range] if one.is_number else ["text", ""]
        missing = f"{one.missing:.1%}" if one.is_number else ""
        rate = "" if rate_hz is None else f"{rate_hz:.4g}"
        rows.append([one.channel.name, one.channel.unit, signal, rate, *cells, missing])
    header = ["channel", "unit", "guess", "Hz", "least", "most", "missing"]
    print_table(f"{file}: {len(rows)} channels", header, rows, left=3)
