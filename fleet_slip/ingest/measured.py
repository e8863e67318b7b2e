"""From a measured file and its mapping to drives in counts, and a quarantine of the rest."""

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import polars as pl
import pyarrow as pa

from fleet_slip.canonical import canonical_ascii
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown
from fleet_slip.ingest.fields import RAW, Field, fields_of, meets_conditions
from fleet_slip.ingest.look_alikes import find_look_alikes
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_drives import cut, drive_id, log_table, to_ticks
from fleet_slip.ingest.parquet_batches import partition_keys
from fleet_slip.ingest.quarantine import DriveKeys, check_rows, with_values
from fleet_slip.ingest.reading import MAX_ROWS, file_digest, read_batches, require_unchanged_file
from fleet_slip.ingest.resampling import STEP_S
from fleet_slip.ingest.row_condition import describe
from fleet_slip.ingest.source import BASE
from fleet_slip.ingest.timebase import cut_into_drives, sample_intervals_s
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA
from fleet_slip.words import number_of

MAX_DRIVES = 10_000
"""Drives in one file. More means that time or the drive's column is not what the mapping says."""
MAX_KEYS = 100_000
"""Combinations of drive metadata in one file, of whatever rows."""
MAX_TICKS = 2 * MAX_ROWS
"""Length of all drives of one file together, in ticks."""


@dataclass(frozen=True)
class IngestCounts:
    """What became of a file's rows.

    `rows_read == rows_left_out + rows_kept + sum(quarantined.values())`.
    """

    rows_read: int
    rows_left_out: int
    """Rows that do not meet the mapping's conditions."""
    rows_kept: int
    quarantined: dict[str, int]
    """Rejected rows by reason."""
    drives: int
    drives_resampled: int
    ticks: int
    """Rows of the result; equal to `rows_kept` where nothing was resampled."""


@dataclass(frozen=True)
class MeasuredLog:
    """A measured file, ready for the warehouse."""

    drives: pa.Table
    """The catalogue's `log_schema` with strings dictionary-encoded, by drive_id, then tick."""
    quarantine: pa.Table
    """`QUARANTINE_SCHEMA`, in the file's order."""
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    """Names of drives or cars in the file that differ only in their Unicode form."""
    digest: str
    """SHA-256 of the file's bytes and the mapping: what has the same one was ingested before."""


def read_measured(file: Path, mapping: Mapping) -> MeasuredLog:
    """Read a file through a mapping.

    The result depends on the file's bytes and the mapping only, not on its path (but for keys in
    the names of folders, `car=A7`, that the mapping uses); drives are called
    `<mapping>-<digest>-<number>`, and `-2`, `-3` … follow where a gap in time cut one.

    Raises `InputError` if the file cannot be read, is not what the mapping says, or has no usable
    row.
    """
    with require_unchanged_file(file):
        digest = _identity(file, mapping)
        rows, bad, keys, read = _check(file, mapping)
    rows, misplaced = cut_into_drives(rows, mapping.time)
    bad = pl.concat([bad, misplaced]).sort("row")
    _require_usable(file, mapping, rows, bad)

    prefix = f"{mapping.name}-{digest[:12]}"
    intervals_s = sample_intervals_s(rows)
    drives = cut(rows, prefix, keys.metadata())
    ticked = [to_ticks(rows[drive.rows], mapping, intervals_s) for drive in drives]
    try:
        table = log_table(drives, ticked, mapping)
    except InputError as error:
        raise InputError(f"{shown(file)}: {error}") from None
    if not table.num_rows:
        raise InputError(
            f"{shown(file)}: its rows are {min(intervals_s.values()):g} s apart and none is on a "
            f"tick of 100 Hz; longest_gap_s = {mapping.time.longest_gap_s:g} forbids to "
            f"interpolate. Raise it in the mapping {mapping.name!r} if the signals change slowly "
            "enough."
        )
    _require_no_signal_lost(file, mapping, rows, table)
    counts = IngestCounts(
        rows_read=read.rows,
        rows_left_out=read.left_out,
        rows_kept=rows.height,
        quarantined=dict(sorted(Counter(bad["reason"]).items())),
        drives=len(drives),
        drives_resampled=sum(drive.method != "snap" for drive in ticked),
        ticks=table.num_rows,
    )
    quarantine = _quarantine_table(file, bad, prefix, mapping, keys)
    names = {text for key in keys.metadata() for text in key.values() if isinstance(text, str)}
    return MeasuredLog(table, quarantine, counts, find_look_alikes(names), digest)


def _identity(file: Path, mapping: Mapping) -> str:
    digest = file_digest(file)
    used = {name for names in mapping.time_bases().values() for name in names}
    if keys := {key: text for key, text in partition_keys(file).items() if key in used}:
        digest.update(canonical_ascii(keys).encode())
    digest.update(mapping.canonical_json().encode())
    return digest.hexdigest()


@dataclass
class _Read:
    """How many rows were read, and how many of them do not meet the mapping's conditions."""

    rows: int = 0
    left_out: int = 0


def _check(file: Path, mapping: Mapping) -> tuple[pl.DataFrame, pl.DataFrame, DriveKeys, _Read]:
    """Read all batches; return the good rows, the bad ones, the drives' keys, and how many rows."""
    good: list[pl.DataFrame] = []
    bad: list[pl.DataFrame] = []
    fields: list[Field] = []
    keys = DriveKeys(fields)
    read = _Read()
    meeting = pl.lit(value=True)
    for batch in read_batches(file, mapping):
        raw = batch.select(pl.all().name.prefix(RAW))
        if not read.rows:
            try:
                fields = fields_of(mapping, raw.schema)
                meeting = meets_conditions(mapping, raw.schema)
            except InputError as error:
                raise InputError(f"{shown(file)}: {error}") from None
            keys = DriveKeys(fields)
        row = pl.int_range(read.rows + 1, read.rows + batch.height + 1, dtype=pl.Int64)
        raw = raw.with_columns(row.alias("row")).filter(meeting)
        raw = raw.rename({RAW + BASE: "base"}, strict=False)
        read.rows += batch.height
        read.left_out += batch.height - raw.height
        valued = with_values(raw, fields)
        rows, rejected = check_rows(keys.number(valued), fields)
        if len(keys) > MAX_KEYS:
            raise InputError(
                f"{shown(file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {mapping.name!r}."
            )
        if mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / mapping.time.rate_hz).alias("time"))
        good.append(rows)
        bad.append(rejected)
    if not read.rows:
        raise InputError(f"{shown(file)}: it has a header and no rows. Export it again.")
    if read.left_out == read.rows:
        raise InputError(
            f"{shown(file)}: none of its {read.rows:,} rows meets the condition of the mapping "
            f"{mapping.name!r}: {describe(mapping.where)}."
        )
    return pl.concat(good), pl.concat(bad), keys, read


def _require_usable(file: Path, mapping: Mapping, rows: pl.DataFrame, bad: pl.DataFrame) -> None:
    if rows.is_empty():
        reasons = ", ".join(f"{n:,} {reason}" for reason, n in Counter(bad["reason"]).most_common())
        first = bad.row(0, named=True)
        example = f"{first['signal'] or 'the row'} = {first['value']!r} in row {first['row']}"
        raise InputError(
            f"{shown(file)}: none of its {number_of(bad.height, 'row')} is usable ({reasons}; "
            "first: "
            f"{example}). Check columns, units and time in the mapping {mapping.name!r}."
        )
    spans = rows.group_by("part").agg((pl.col("time").last() - pl.col("time").first()).alias("s"))
    if spans.height > MAX_DRIVES:
        raise InputError(
            f"{shown(file)}: it falls into {spans.height:,} drives, at most {MAX_DRIVES:,} are "
            f"read. Check time, split_gap_s and the drive's column in the mapping {mapping.name!r}."
        )
    if (ticks := float(spans["s"].sum()) / STEP_S) > MAX_TICKS:
        raise InputError(
            f"{shown(file)}: its drives last {ticks:,.0f} ticks of 100 Hz, at most {MAX_TICKS:,} "
            f"are read. Check the unit of time and split_gap_s in the mapping {mapping.name!r}."
        )


def _require_no_signal_lost(
    file: Path, mapping: Mapping, rows: pl.DataFrame, table: pa.Table
) -> None:
    """Raise `InputError` for a signal that the file has and no tick: it would be gone unseen."""
    for name, source in mapping.signals.items():
        samples = rows.height - rows[name].null_count()
        if samples and table[name].null_count == table.num_rows:
            raise InputError(
                f"{shown(file)}: {name} has {number_of(samples, 'value')} in {source.column!r}, "
                "and none is on a tick of 100 Hz: they are further apart than longest_gap_s. Give "
                f"the signal in the mapping {mapping.name!r} a longest_gap_s of its own, or "
                "interpolate = false."
            )


def _quarantine_table(
    file: Path, bad: pl.DataFrame, prefix: str, mapping: Mapping, keys: DriveKeys
) -> pa.Table:
    name = os.fsencode(file.name).decode("utf-8", "replace")
    groups = bad["group"].unique().drop_nulls()
    ids = {group: drive_id(prefix, group) for group in groups}
    stated = mapping.drive.vehicle_id
    vehicle = stated if isinstance(stated, str) else None
    metadata = keys.metadata()
    vehicles = {str(group): metadata[group].get("vehicle_id", vehicle) for group in groups}
    frame = bad.select(
        pl.lit(name).alias("file"),
        "row",
        pl.col("group").replace_strict(ids, return_dtype=pl.String).alias("drive_id"),
        pl.col("group")
        .cast(pl.String)
        .replace_strict(vehicles, return_dtype=pl.String)
        .fill_null(pl.lit(vehicle, pl.String))
        .alias("vehicle_id"),
        "reason",
        "signal",
        "value",
    )
    return frame.to_arrow().cast(QUARANTINE_SCHEMA)
