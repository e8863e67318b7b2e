"""Reads a measured file as drives in counts, block by block, with few drives in memory."""

import hashlib
import json
import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from collections.abc import Mapping as Named
from contextlib import closing, contextmanager
from datetime import date
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa

from fleet_slip.base import canonical_ascii, pluralize, quote_name
from fleet_slip.catalog.signals import LONGEST_PAUSE_S
from fleet_slip.compute.tasks import read_ahead
from fleet_slip.errors import InputError
from fleet_slip.ingest.checked_columns import (
    DriveKeys,
    IngestCounts,
    check_rows,
    describe_rejected,
    is_grouped,
)
from fleet_slip.ingest.columns import STEP_S, TIME_EPSILON_S
from fleet_slip.ingest.drives import DriveCutter, DriveSamples, sort_by_group
from fleet_slip.ingest.formats.reading import file_errors, require_unchanged_log
from fleet_slip.ingest.formats.source import Spool
from fleet_slip.ingest.formats.tables import partition_keys
from fleet_slip.ingest.log_files import FileGroup, open_log
from fleet_slip.ingest.mapping import FromColumn, Mapping
from fleet_slip.ingest.ticks import FINGERPRINT_PREFIX, MeasuredDrive, drive_id, to_ticks
from fleet_slip.ingest.vocabulary import is_called, vocabulary
from fleet_slip.quality.checks import CHECKS, Check, Fault, implausible_day
from fleet_slip.warehouse.warehouse import quarantine_schema

MAX_DRIVES = 10_000
"""Maximum number of short drives in a file. More mean a wrong time or a wrong drive column."""
SHORT_ROWS = 1000
MAX_TICKS = 40_000_000
"""Maximum ticks of a file, unless it has a row for each `MAX_TICKS_PER_ROW` ticks."""
MAX_TICKS_PER_ROW = 1000


MAX_REJECTED_IN_MEMORY = 2**18
"""Maximum rejected rows in memory; the others are in a temporary file."""


class RejectedRows:
    """The rejected rows of a log, few of them in memory.

    Attributes
    ----------
    counts
        Their number by field and reason.
    first
        The first one.
    """

    def __init__(self) -> None:
        """Begin without rows."""
        self.counts = Counter[tuple[str, str]]()
        self.first: dict[str, Any] | None = None
        self._rows: list[pl.DataFrame] = []
        self._spool = Spool()

    def add(self, rows: pl.DataFrame) -> None:
        """Count and store rows. Raises `InputError` if the disk is full."""
        if not rows.height:
            return
        self.first = self.first or rows.row(0, named=True)
        for signal, reason, number in rows.group_by("signal", "reason").len().iter_rows():
            self.counts[signal or "", reason] += number
        self._rows.append(rows)
        if sum(frame.height for frame in self._rows) >= MAX_REJECTED_IN_MEMORY:
            content = BytesIO()
            pl.concat(self._rows).write_ipc_stream(content)
            self._spool.add("", content.getvalue())
            self._rows = []

    def by_reason(self) -> dict[str, int]:
        """Return the number of rows by reason."""
        reasons = Counter[str]()
        for (_, reason), number in self.counts.items():
            reasons[reason] += number
        return dict(sorted(reasons.items()))

    def frames(self) -> Iterator[pl.DataFrame]:
        """Yield the rows."""
        yield from map(pl.read_ipc_stream, self._spool.read(""))
        if self._rows:
            yield pl.concat(self._rows)


class MeasuredLog:
    """A measured file, open for reading through a mapping.

    The result depends on the file's bytes and the mapping only, not on its path (but for keys in
    the names of folders, `car=A7`, that the mapping uses), nor on how it is read. Drives are called
    `<mapping>-<digest>-<number>`, and `-2`, `-3` … follow where a gap in time cut one.
    """

    def __init__(self, file: Path, mapping: Mapping, digest: str, content_digest: str) -> None:
        """Take the file, the mapping, and the two digests of `_identity`."""
        self.file, self.mapping, self.digest = file, mapping, digest
        self.fingerprint = f"{FINGERPRINT_PREFIX}{content_digest[:16]}"
        self.prefix = f"{mapping.name}-{digest[:12]}"
        self._keys = DriveKeys()
        self.counts = IngestCounts()
        self.longest: MeasuredDrive | None = None
        self._rejected = RejectedRows()
        self._samples, self._values_on_ticks = Counter[str](), Counter[str]()
        """Numbers of samples in the file, and of values on ticks, by signal."""
        self._segments: Counter[int] = Counter()
        """Number of drives of each group so far: the segments between gaps in time."""
        self._changed = date.fromtimestamp(file.stat().st_mtime)
        self._implausible_days: list[tuple[date, str]] = []
        self._trips: dict[int, tuple[str, float]] = {}
        """The trip of each group's last drive, and when that ended."""
        self._times_s = defaultdict[str, list[tuple[float, float]]](list)
        """The first and the last time of the dated drives of each car."""
        self.name = os.fsencode(file.name).decode("utf-8", "replace")
        self._stem = self.name.split(".", 1)[0] or self.name

    def drives(self) -> Iterator[MeasuredDrive]:
        """Yield the drives of the file as they end. It can be called once.

        The order depends on the file and the mapping only. Raises `InputError`, also at the end.
        """
        grouped = is_grouped(self.file, self.mapping)
        cutter = DriveCutter(self.mapping.time.split_gap_s, self._rejected.add)
        with closing(read_ahead(self._checked_rows())) as blocks:
            for block in blocks if grouped else sort_by_group(blocks):
                yield from self._resample(cutter.cut(block))
            yield from self._resample(cutter.end_group())
        self.counts.quarantined = self._rejected.by_reason()
        self._require_usable()

    def _checked_rows(self) -> Iterator[pl.DataFrame]:
        """Yield the good rows of each batch; store the rejected ones."""
        for rows, rejected in check_rows(self.file, self.mapping, self._keys, self.counts):
            self._rejected.add(rejected)
            yield rows

    def _resample(self, segments: Iterable[DriveSamples]) -> Iterator[MeasuredDrive]:
        """Yield the drives of segments; reject segments shorter than a tick."""
        for rows in segments:
            if rows.end_s - rows.start_s < STEP_S - TIME_EPSILON_S:
                self._rejected.add(describe_rejected(rows.frame, "too_short"))
                continue
            drive = self._drive(rows)
            self._record(rows, drive)
            self._require_sane_drives()
            yield drive

    def _drive(self, rows: DriveSamples) -> MeasuredDrive:
        """Name a drive, assign it to a trip, and resample it. Raises `InputError`."""
        group = rows.group
        self._segments[group] += 1
        name = drive_id(self.prefix, group, self._segments[group])
        trip_id, ended_s = self._trips.get(group, (name, rows.start_s))
        if not 0 <= rows.start_s - ended_s <= LONGEST_PAUSE_S:  # or the clock went back
            trip_id = name
        self._trips[group] = trip_id, rows.end_s
        metadata = dict(self._keys.metadata[group])
        metadata["drive_name"] = metadata.pop("drive", self._stem)
        metadata |= {"source_file": self.name, "trip_id": trip_id}
        try:
            return to_ticks(rows, self.mapping, name, metadata)
        except InputError as error:
            raise InputError(f"{quote_name(self.file)}: {error}") from None

    def _record(self, rows: DriveSamples, drive: MeasuredDrive) -> None:
        """Add a drive to the counts, and to the figures of the checks of the file."""
        self.counts.rows_kept += rows.height
        self.counts.drives += 1
        self.counts.drives_resampled += drive.method != "snap"
        self.counts.ticks += drive.ticks.size
        for base_rows in rows.bases.values():
            for signal in drive.values_on_ticks.keys() & set(base_rows.columns):
                self._samples[signal] += base_rows[signal].count()
        self._values_on_ticks.update(drive.values_on_ticks)
        if self.longest is None or drive.ticks.size > self.longest.ticks.size:
            self.longest = drive
        if drive.metadata["started_at"] is not None:
            car = str(drive.metadata["vehicle_id"])
            self._times_s[car].append((rows.start_s, rows.end_s))
        if why := implausible_day(drive.metadata["day"], self._changed):
            self._implausible_days.append((drive.metadata["day"], why))

    def _error(self, problem: str) -> InputError:
        """Return an error that names the file and the mapping."""
        name = self.mapping.name
        return InputError(f"{quote_name(self.file)}: {problem} in the mapping {name!r}.")

    def _require_sane_drives(self) -> None:
        """Raise `InputError` for too many drives, or too many ticks, for the number of rows."""
        counts, problem = self.counts, ""
        if counts.drives > MAX_DRIVES and counts.rows_kept < SHORT_ROWS * counts.drives:
            rows = counts.rows_kept / counts.drives
            problem = f"it splits into {counts.drives:,} drives of {rows:.0f} rows on average"
        if counts.ticks > MAX_TICKS and counts.ticks > MAX_TICKS_PER_ROW * counts.rows_kept:
            problem = f"{counts.rows_kept:,} rows span {counts.ticks:,} ticks of 100 Hz"
        if problem:
            check = "Check the unit of time, split_gap_s and the drive's column"
            raise self._error(f"{problem}. {check}")

    def _require_usable(self) -> None:
        """Raise `InputError` if all rows together give no row, no tick or no value of a signal."""
        counts, mapping = self.counts, self.mapping
        if not counts.rows_kept and (first := self._rejected.first):
            reasons = Counter(counts.quarantined)
            texts = ", ".join(f"{n:,} {reason}" for reason, n in reasons.most_common())
            raise self._error(
                f"none of {pluralize(reasons.total(), 'row')} is usable ({texts}; first: "
                f"{first['signal'] or 'the row'} = {first['value']!r} in row {first['row']}). "
                "Check columns, units and time"
            )
        if not counts.ticks:
            raise self._error(
                "no row is on a tick of 100 Hz, and longest_gap_s = "
                f"{mapping.time.longest_gap_s:g} prevents interpolation. Raise it, if the signals "
                "change slowly enough,"
            )
        for signal, count in self._samples.items():
            if not self._values_on_ticks[signal]:
                raise self._error(
                    f"{signal} has {pluralize(count, 'value')} in "
                    f"{mapping.signals[signal].column!r}, and none is on a tick of 100 Hz: they "
                    "are further apart than longest_gap_s. Give the signal a longest_gap_s of its "
                    "own, or interpolate = false,"
                )

    def quarantine(self) -> Iterator[pa.Table]:
        """Yield the rows of the table `quarantine`. Call it after `drives` has ended."""
        stated, stored = self.mapping.drive.vehicle_id, quarantine_schema()
        vehicle = stated if isinstance(stated, str) else None
        metadata = enumerate(self._keys.metadata)
        groups = [(g, drive_id(self.prefix, g), m.get("vehicle_id", vehicle)) for g, m in metadata]
        schema = {"group": pl.Int32, "drive_id": pl.String, "vehicle_id": pl.String}
        names = pl.DataFrame(groups, schema, orient="row")
        for rows in self._rejected.frames():
            named = rows.sort("row", maintain_order=True).join(
                names, on="group", how="left", maintain_order="left"
            )
            frame = named.with_columns(
                pl.lit(self.name).alias("file"),
                pl.col("vehicle_id").fill_null(pl.lit(vehicle, pl.String)),
            )
            yield frame.select(stored.names).to_arrow().cast(stored)

    def suspicions(self) -> tuple[Fault, ...]:
        """Return the faults of the file as a whole. Call it after `drives` has ended."""
        counts, time = self.counts, self.mapping.time
        of_signals = {
            key: n for key, n in self._rejected.counts.items() if key[0] in self.mapping.signals
        }
        faults = [*find_rejections(of_signals, counts.rows_read, counts.quarantined)]
        if twice := sum(map(_overlaps, self._times_s.values())):
            faults.append(CHECKS["one car twice at a time"].fault("time", count=twice))
        rate_khz = 1e-3 / self.longest.interval_s if self.longest else 0.0
        rate = CHECKS["rate of the samples"]
        if rate_khz > rate.high:
            faults.append(rate.fault("time", rate_khz=rate_khz))
        if days := self._implausible_days:
            drives, (day, why) = pluralize(len(days), "drive"), min(days)
            check = CHECKS["date of a drive"]
            faults.append(check.fault("day", drives=drives, day=day, why=why))
        faults += _unmapped_cars(self.file, self.mapping, counts.drives)
        if time.assumed:
            faults.append(CHECKS["assumed rate"].fault("rate_hz", rate_hz=time.rate_hz))
        return tuple(faults)


@contextmanager
def open_measured(file: Path, mapping: Mapping) -> Iterator[MeasuredLog]:
    """Open a measured file. Raises `InputError`, if it changes until the end too."""
    mapping = mapping.for_file(file)
    with require_unchanged_log(file):
        yield MeasuredLog(file, mapping, *_identity(file, mapping))


def _identity(file: Path, mapping: Mapping) -> tuple[str, str]:
    """Return two digests: of the file with the mapping, and of its content alone.

    The keys of its folders, `car=A7`, count as content. The first digest includes only those that
    the mapping uses.
    """
    if isinstance(file, FileGroup):
        digest = hashlib.sha256()
        for member, files in sorted(file.members.items()):
            digests = [_file_digest(part).hexdigest() for part in files]
            digest.update(canonical_ascii({member: digests}).encode())
    else:
        digest = _file_digest(file)
    content, of_folders = digest.copy(), partition_keys(file)
    used = mapping.columns
    if keys := {key: text for key, text in of_folders.items() if key in used}:
        digest.update(canonical_ascii(keys).encode())
    content.update(canonical_ascii(of_folders).encode())
    digest.update(mapping.canonical_json().encode())
    return digest.hexdigest(), content.hexdigest()


MAX_SPARSE_BYTES, SPARSE_RATIO = 2**30, 64
"""A larger file is refused if its size is more than this multiple of its space on disk."""


def _file_digest(file: Path) -> "hashlib._Hash":
    """Return the SHA-256 of a file's bytes. Raises `InputError`.

    Large files of almost only holes are refused, since reading them takes long. A file in a
    compressed file system takes less space too, but it has no hole.
    """
    with file_errors(file), file.open("rb") as stream:
        status = os.fstat(stream.fileno())
        size, written = status.st_size, 512 * status.st_blocks
        if size > max(MAX_SPARSE_BYTES, SPARSE_RATIO * written):
            if stream.seek(0, os.SEEK_HOLE) < size:
                raise InputError(
                    f"{quote_name(file)}: its size is {size:,} bytes, but only {written:,} were "
                    "ever written. Copy it again."
                )
            stream.seek(0)
        return hashlib.file_digest(stream, "sha256")


# Faults of a log as a whole: many rejected rows, a car in two drives at once, and an unmapped
# column that is named like cars.

MIN_REJECTED = 10
_REFUSED: dict[str, Check] = {
    "out_of_range": CHECKS["values out of range"],
    "not_a_number": CHECKS["texts in place of numbers"],
    "not_finite": CHECKS["values that are not finite"],
}
_OF_TIME = ("time", "isolated", "too_short", "not_a_time")
MAX_NAMES, MIN_ROWS_PER_NAME = 1000, 20


def find_rejections(
    rejected: Named[tuple[str, str], int], rows: int, reasons: Named[str, int]
) -> Iterator[Fault]:
    """Yield a fault for each signal that rejects more than a tenth of a file's rows.

    The rejected rows of all other reasons together are a fault above the same limit. `rejected` are
    rejected rows by signal and reason, `reasons` all rejected rows by reason.
    """
    limit = max(rows * CHECKS["refused rows"].high, MIN_REJECTED)
    several = {key: count for key, count in rejected.items() if count > limit}
    for (name, reason), count in several.items():
        check = _REFUSED.get(reason, CHECKS["refused values"])
        yield check.fault(name, count=count, rows=rows, reason=reason)
    remaining = Counter(reasons)
    for (_, reason), count in several.items():
        remaining[reason] -= count
    if remaining.total() <= limit:
        return
    ((reason, count),) = remaining.most_common(1)
    figures = {"count": remaining.total(), "rows": rows, "most": count, "reason": reason}
    if reason.startswith(_OF_TIME):
        is_mixed = reason in {"time_duplicate", "time_backwards"}
        mixed = ", and set vehicle_id or drive.column if the file mixes cars or trips"
        yield CHECKS["refused times"].fault("time", mixed=mixed if is_mixed else "", **figures)
    else:
        yield CHECKS["refused rows"].fault("rows", **figures)


def _unmapped_cars(file: Path, mapping: Mapping, drives: int) -> Iterator[Fault]:
    """Yield faults for unmapped columns with several values that are named like cars or trips.

    `drives` is the number of drives of the file. A log with clocks belongs to one car.
    """
    unmapped = {
        key: words
        for key, words in vocabulary()["cars"].items()
        if not (mapping.drive.column or isinstance(getattr(mapping.drive, key), FromColumn))
    }
    if mapping.time.own_clock or not unmapped:
        return
    check = CHECKS["unused column of cars or trips"]
    with file_errors(file), open_log(file, mapping.formats) as source:
        names = [channel.name for channel in source.channels()]
        free = [n for n in names if n not in mapping.columns and names.count(n) == 1]
        for key, words in unmapped.items():
            for name in (name for name in free if is_called(words, name)):
                values, rows = set[str](), 0
                for batch in source.batches([name]):
                    texts = batch[name].cast(pl.String).str.strip_chars().replace("", None)
                    values.update(texts.drop_nulls().unique())
                    rows += texts.count()
                    if len(values) > MAX_NAMES:
                        break
                count = len(values)  # a quantity has more
                is_name = check.high < count <= min(MAX_NAMES, rows // MIN_ROWS_PER_NAME)
                if is_name and (key == "vehicle_id" or count > drives):
                    where = f"column = {json.dumps(name, ensure_ascii=False)}"
                    where = f"{key} = {{ {where} }}" if key != "column" else where
                    yield check.fault(name, count=count, where=where)


def _overlaps(times_s: list[tuple[float, float]]) -> int:
    """Return the number of drives that begin before an earlier drive has ended."""
    ordered = sorted(times_s)
    latest = accumulate((end for _, end in ordered), max)
    return sum(
        start < end - CHECKS["one car twice at a time"].high
        for (start, _), end in zip(ordered[1:], latest, strict=False)
    )
