"""Commits a batch of measured files: `write_batch` writes data files, `commit_batch` commits them.

Left out are drives that were forgotten, and files and recordings that are in the logs already.
"""

import json
import os
import re
from collections import abc
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from itertools import chain, count, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.arrays import IntArray
from fleet_slip.base import Progress, no_progress, number_of, shown
from fleet_slip.caches import cache_folder
from fleet_slip.catalogue.faults import Fault
from fleet_slip.catalogue.signals import as_arrow, catalogue
from fleet_slip.errors import ConflictError, InputError, RepeatedError
from fleet_slip.ingest.drives import MeasuredDrive, drive_id
from fleet_slip.ingest.formats.source import Spool
from fleet_slip.ingest.log_files import Log, StoredParts, local_copies
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.preview import signals_of
from fleet_slip.ingest.stream import IngestCounts, MeasuredStream, open_measured
from fleet_slip.ingest.suspicion import find_suspicions
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.table import WITHDRAWN, Change, Snapshot, Table, Unit, retry_conflicts
from fleet_slip.warehouse.forgotten import ALLOWED, Audit, Forgettable
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse, connect_tables

TableName: TypeAlias = Literal["quarantine", "logs"]
Replace: TypeAlias = Literal["no", "corrected", "all"]
"""Which recordings of the logs give way to the same ones: `corrected` are those of the same file
through a mapping of the same name that has changed since."""


def tables_of(warehouse: Warehouse) -> dict[TableName, Table]:
    """Return the tables that files go to, in the order in which they are committed."""
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


# What was forgotten does not come back.


def keep_drives(drives: Sequence[MeasuredDrive], audit: Audit) -> list[MeasuredDrive]:
    """Return the drives that were not forgotten under any name, nor their cars."""
    barred = audit.barred(set(map(car_of, drives)), {drive.drive_id for drive in drives})
    counts = audit.barred_counts()
    return [
        drive
        for drive in drives
        if drive.drive_id not in barred.drives
        and car_of(drive) not in barred.vehicles
        and not (counts and drive.counts_digest in counts)
    ]


def keep_refused(refused: pa.Table, audit: Audit, left_out: Collection[str] = ()) -> pa.Table:
    """Return the refused rows of what was not forgotten; `left_out` are drives of their file.

    A row goes with its car, or with its drive, whose name begins that of each stretch of it.
    """
    vehicles, named = names_in(refused, "vehicle_id"), names_in(refused, "drive_id")
    barred = audit.barred(vehicles, named)
    drives = barred.drives | set(left_out)
    whole = {name for name in named if any(drive.startswith(f"{name}-") for drive in drives)}
    for column, unwanted in (("vehicle_id", barred.vehicles), ("drive_id", drives | whole)):
        if unwanted:
            names = pa.array(sorted(unwanted), pa.string())
            mine = pc.is_in(refused[column].cast(pa.string()), names)
            refused = refused.filter(pc.invert(pc.fill_null(mine, False)))
    return refused


def car_of(drive: MeasuredDrive) -> str:
    """Return the name of the car of a drive."""
    return str(drive.metadata["vehicle_id"])


def names_in(rows: pa.Table, column: str) -> frozenset[str]:
    """Return the names that stand in a column of rows."""
    return frozenset(rows[column].unique().drop_null().cast(pa.string()).to_pylist())


# Fingerprints recognise a recording: a digest of a file's bytes, or of a drive's counts. Each is a
# unit of work in the commit of the rows, so that two processes that load one drive are in conflict.
# Its number says where it is from, and no name of a car follows from it:
#
#     40 bits of the file's digest | 3 bits: 0 of a file | 20 bits of the drive's name

FILES, PREFIX = "ingest/", "same/"
DIGEST_CHARACTERS = 10
_DRIVE_BITS, _KIND_BITS = 20, 3

MEASURED = rf"-([0-9a-f]{{{DIGEST_CHARACTERS}}})[0-9a-f]{{2}}((-[0-9]+){{1,2}})$"
"""What the name of a measured drive ends in: its file's digest, and which drive of it."""

_MEASURED = re.compile(MEASURED)


class Origin(NamedTuple):
    """Where a recording is from: the first characters of a file's digest, and a drive's hash or 0.

    0 stands for the whole file.
    """

    digest: str
    drive: int = 0

    @classmethod
    def of(cls, digest: str) -> "Origin":
        """Return the origin of a file with this digest."""
        return cls(digest[:DIGEST_CHARACTERS])

    @classmethod
    def of_drive(cls, drive_id: str) -> "Origin | None":
        """Return the origin of a drive; None if its name is not that of a measured one."""
        if (found := _MEASURED.search(drive_id)) is None:
            return None
        hashed = int(sha256(found[2].encode()).hexdigest(), 16)
        return cls(found[1], 1 + hashed % (2**_DRIVE_BITS - 1))

    @classmethod
    def of_number(cls, number: int) -> "Origin":
        """Return the origin that a fingerprint's number says."""
        digest = number >> (_KIND_BITS + _DRIVE_BITS)
        return cls(f"{digest:0{DIGEST_CHARACTERS}x}", number % 2**_DRIVE_BITS)

    @property
    def number(self) -> int:
        """Number of a fingerprint from here."""
        kind = int(self.drive != 0) << _DRIVE_BITS
        return int(self.digest, 16) << (_KIND_BITS + _DRIVE_BITS) | kind | self.drive

    @property
    def file(self) -> "Origin":
        """The file that it is, or is in."""
        return Origin(self.digest)


def is_from(drive_id: str, origins: Collection[Origin]) -> bool:
    """Whether a drive is one of some, or came in a file of theirs."""
    origin = Origin.of_drive(drive_id)
    return origin is not None and (origin in origins or origin.file in origins)


class Fingerprints:
    """The fingerprints of what is in the logs."""

    def __init__(self, units: abc.Mapping[str, int]) -> None:
        """Take the units of a snapshot of the logs."""
        there = {name: number for name, number in units.items() if number != WITHDRAWN}
        self._numbers = {name: n for name, n in there.items() if name.startswith(PREFIX)}
        self._files = [name for name in there if name.startswith(FILES)]

    def find(self, fingerprints: Iterable[str]) -> frozenset[Origin]:
        """Return which files, and which drives of others, have the same fingerprints."""
        numbers = map(self._numbers.get, fingerprints)
        return frozenset(Origin.of_number(number) for number in numbers if number is not None)

    def withdraw(self, origins: Collection[Origin], files: Collection[Origin]) -> list[Unit]:
        """Return what withdraws fingerprints of origins, and files themselves that are all gone."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (origin := Origin.of_number(number)) in origins or origin.file in files
        ]
        of_files = [n for n in self._files if Origin.of(n.removeprefix(FILES)) in files]
        return [Unit(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"{FILES}{digest}", 1)


def digest_of(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


# Data files of bounded size. Nothing is committed yet.

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""

Rows: TypeAlias = Sequence[MeasuredDrive] | Sequence[pa.Table]
"""Drives for the logs, or refused rows for the quarantine."""

_POLARS_TYPES: dict[pa.DataType, type[pl.DataType] | pl.DataType] = {
    pa.string(): pl.String,
    pa.float64(): pl.Float64,
    pa.int64(): pl.Int64,
    pa.int32(): pl.Int32,
    pa.date32(): pl.Date,
    pa.timestamp("us", tz="UTC"): pl.Datetime("us", "UTC"),
}


class NewFiles(NamedTuple):
    """Data files of one table that are not committed yet, and the units of work that they are."""

    units: tuple[Unit, ...]
    files: tuple[AddAction, ...]


class DataFiles:
    """Data files of a batch in one table. Logs are read one by one, and ended or discarded."""

    def __init__(self, table: Table, mapping: Mapping, threads: ThreadPoolExecutor) -> None:
        """Take the table, the logs' mapping, and threads to write with."""
        self._table, self._mapping, self._threads = table, mapping, threads
        self._written: list[Future[list[AddAction]]] = []
        self._of_this_log: list[Future[list[AddAction]]] = []
        self._waiting: dict[str, Rows] = {}
        self.digests: list[str] = []

    def add(self, name: str, rows: Rows) -> None:
        """Write rows of the log that is being read to a data file of their own."""
        self._of_this_log.append(self._begin(name, rows))

    def end_log(self, digest: str, rest: Rows) -> None:
        """End the log that is being read: the rest of its rows wait for those of others."""
        if self._of_this_log or rest:
            self.digests.append(digest)
        self._written += self._of_this_log
        self._of_this_log = []
        if rest:
            self._waiting[digest] = rest
        if sum(one.num_rows for rows in self._waiting.values() for one in rows) >= FILE_ROWS:
            self.write_waiting()

    def discard_log(self) -> None:
        """Delete what was written of the log that is being read."""
        written = [writing for writing in self._of_this_log if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())
        self._of_this_log = []

    def write_waiting(self) -> None:
        """Write rows in the order of their logs' digests, and so of the names of drives."""
        digests = sorted(self._waiting)
        if digests:
            rows: Any = [one for digest in digests for one in self._waiting[digest]]
            self._written.append(self._begin(f"measured-{digest_of(digests)[:24]}", rows))
            self._waiting = {}

    def finish(self) -> NewFiles:
        """Return all data files, written, and the units that they are."""
        self.write_waiting()
        files = tuple(file for writing in self._written for file in writing.result())
        return NewFiles(tuple(map(unit_of, sorted(self.digests))), files)

    def _begin(self, name: str, rows: Rows) -> Future[list[AddAction]]:
        """Write rows while the caller goes on; at most `WRITERS` files are under way."""
        begun = [*self._written, *self._of_this_log]
        if len(begun) >= WRITERS:
            begun[-WRITERS].result()
        return self._threads.submit(self._write, name, rows)

    def _write(self, name: str, rows: Rows) -> list[AddAction]:
        by_day = _by_day(_as_table(rows, self._mapping))
        encoded = {day: self._table.encode(part) for day, part in by_day.items()}
        del by_day  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def _as_table(rows: Rows, mapping: Mapping) -> pa.Table:
    tables = [one for one in rows if isinstance(one, pa.Table)]
    if tables:
        return pa.concat_tables(tables).unify_dictionaries()
    return log_table([one for one in rows if isinstance(one, MeasuredDrive)], mapping)


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    """Return the rows of each day; refused ones, which are not kept by day, as they are."""
    if "day" not in rows.column_names:
        return {None: rows}
    days = rows["day"].unique().to_pylist()
    if len(days) == 1:
        return {days[0]: rows}
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def log_table(drives: Sequence[MeasuredDrive], mapping: Mapping) -> pa.Table:
    """Return the rows of `logs` for these drives; strings are dictionary-encoded."""
    drive_of_row = np.repeat(np.arange(len(drives)), [drive.ticks.size for drive in drives])
    columns = {}
    for column in catalogue().log_schema:
        if column.name == "tick":
            ticks = [as_arrow(drive.ticks) for drive in drives]
            columns[column.name] = pa.chunked_array(ticks, column.type)
        elif column.name in mapping.signal_names:
            columns[column.name] = pa.chunked_array([drive.counts[column.name] for drive in drives])
        elif column.name in catalogue().extras:
            continue
        elif column.name in catalogue().signals:
            columns[column.name] = pa.nulls(drive_of_row.size, column.type)
        else:
            values = [drive.metadata.get(column.name) for drive in drives]
            columns[column.name] = _gather(values, drive_of_row, column.type)
    return pa.table(columns)


def _gather(values: Sequence[Any], at: IntArray, kind: pa.DataType) -> pa.Array:
    """Return values at positions; not by `pa.array`, which imports pandas if it is there."""
    if pa.types.is_string(kind):
        texts = list(dict.fromkeys(text for text in values if text is not None))
        codes = [None if text is None else texts.index(text) for text in values]
        named = pl.Series(texts, dtype=pl.String).to_arrow().cast(kind)
        return pa.DictionaryArray.from_arrays(_gather(codes, at, pa.int32()), named, safe=False)
    return pl.Series(values, dtype=_POLARS_TYPES[kind]).gather(at).to_arrow().cast(kind)


# Which files of this machine are known: a cache, so that a folder of thousands need not be read to
# find nothing new. Whether their content is in the logs is asked of the logs.


@dataclass
class KnownFiles:
    """Which content the files of this machine had when they were ingested through a mapping.

    `digests` has size, time of change (of an object, the store's version) and digest by path or
    URL.
    """

    cache: Path
    digests: dict[str, tuple[int, int | str, str]] = field(default_factory=dict)

    @classmethod
    def of(cls, warehouse: Warehouse, mapping: Mapping) -> "KnownFiles":
        """Return what is remembered for a data root and a mapping."""
        about = sha256(f"{warehouse.root.uri}\n{mapping.canonical_json()}".encode()).hexdigest()
        cache = cache_folder("ingested") / f"{about[:32]}.json"
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            files = json.loads(cache.read_bytes())["files"]
            return cls(cache, {path: (int(s), t, str(d)) for path, (s, t, d) in files.items()})
        return cls(cache)

    def without_landed(self, files: Iterable[Log], warehouse: Warehouse) -> list[Log]:
        """Return the files that are not in the logs, as far as size and time of change tell."""
        landed = warehouse.logs.snapshot().landed_among(len(self.digests))

        def is_there(file: Log) -> bool:
            known = self.digests.get(_name_of(file))
            return known is not None and _state_of(file) == known[:2] and landed(FILES + known[2])

        return [file for file in files if not is_there(file)]

    def digest_of(self, file: Log) -> str | None:
        """Return the digest of what a path had when it was ingested, None if it never was."""
        known = self.digests.get(_name_of(file))
        return None if known is None else known[2]

    def remember(self, file: Log, digest: str) -> None:
        """Keep in mind that a file is in the logs."""
        if state := _state_of(file):
            self.digests[_name_of(file)] = (*state, digest)

    def save(self) -> None:
        """Write the cache; what cannot be written is not kept."""
        with suppress(OSError):
            self.cache.parent.mkdir(parents=True, exist_ok=True)
            draft = self.cache.with_suffix(f".{os.getpid()}")
            draft.write_text(json.dumps({"files": self.digests}))
            draft.replace(self.cache)


def _name_of(log: Log) -> str:
    return os.path.abspath(log) if isinstance(log, Path) else str(log)  # noqa: PTH100 - the faster


def _state_of(log: Log) -> tuple[int, int | str] | None:
    """Return what changes when the content does; None if that is not known."""
    if isinstance(log, StoredFile):
        return log.size_bytes, log.identity
    if isinstance(log, StoredParts):
        return None
    try:
        found = log.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


# What becomes of a file whose recording is in the logs already.


class SameRecordings:
    """Looks for the recordings of a batch of files, in the logs and in the batch."""

    def __init__(
        self, warehouse: Warehouse, logs: Snapshot, mapping: str, replace: Replace
    ) -> None:
        """Take a snapshot of the logs, the mapping's name, and what is to give way."""
        self._warehouse, self._logs = warehouse, logs
        self._mapping, self._replace = mapping, replace
        self._logs_have: Fingerprints | None = None
        self._batch: dict[str, int] = {}
        self._files: dict[str, Log] = {}

    def judge(self, one: "FileOutcome", name: str, earlier: str | None) -> None:
        """Say in a file's outcome what the logs have of it, and what gives way to it.

        `name` is the file's as `source_file` has it; `earlier` is the digest of what its path had
        before, if that is there. Raises `RepeatedError` for what does not give way to it.
        """
        for origin in Fingerprints(self._batch).find(one.fingerprints):
            # Another one: the same bytes count once anyway.
            raise RepeatedError(
                f"{shown(one.file)}: it has the recording of {shown(self._files[origin.digest])}, "
                "which is ingested with it. Leave one of them out."
            )
        if self._logs_have is None:
            self._logs_have = Fingerprints(self._logs.units)
        origins = self._logs_have.find(one.fingerprints)
        changed = earlier is not None and earlier != one.digest
        if earlier is not None and changed:
            origins |= {Origin.of(earlier)}
        there = _drives_of(self._warehouse, {origin.file for origin in origins})
        replaced = _replaced(there, origins, name)
        drives = [drive for drive in there if is_from(drive, replaced)]
        gives_way = self._replace == "all" or (
            self._replace == "corrected"
            and not changed
            and replaced <= {origin for origin in origins if not origin.drive}
            and all(drive.startswith(f"{self._mapping}-{_digest(drive)}") for drive in drives)
        )
        if drives and not gives_way:
            what = "its recording is in the logs"
            what = "it has changed since it was ingested" if changed else what
            source, more = shown(there[drives[0]]), number_of(len(drives), "drive")
            such = drives[0] if len(drives) == 1 else f"{more}, {drives[0]} …"
            raise RepeatedError(
                f"{shown(one.file)}: {what}, and would count twice: {such} from {source}. To put "
                "this in its place, give the command again with --replace; to take the old one "
                f"out: fleet-slip ingest --undo {source}"
            )
        self._batch.update(one.fingerprints)
        self._files[Origin.of(one.digest).digest] = one.file
        one.same = origins
        one.replaced = replaced if drives else frozenset()
        one.drives_replaced = len(drives)


def let_return(warehouse: Warehouse, digest: str, first_drive: str) -> bool:
    """Withdraw a file of which no drive is left, and whose first one may come back; say if so.

    Only what was forgotten by a drive's or a file's name may: what is too old stays away.
    """
    audit = Audit(warehouse.root)
    if not audit.allows_drives or audit.state(Forgettable("drive", first_drive)) != ALLOWED:
        return False

    def attempt(table: Table) -> None:
        snapshot = table.snapshot()
        if _drives_of(warehouse, {Origin.of(digest)}):
            return
        if snapshot.landed(f"{FILES}{digest}") not in {None, WITHDRAWN}:
            units = (Unit(f"{FILES}{digest}", WITHDRAWN),)
            snapshot.commit(Change(units=units, note={"job": "undo"}))

    for table in tables_of(warehouse).values():
        retry_conflicts(partial(attempt, table))
    return True


def are_gone(warehouse: Warehouse, digest: str) -> bool:
    """Whether drives were forgotten, and none is left of a file that was ingested."""
    return bool(Audit(warehouse.root).entries()) and not _drives_of(warehouse, {Origin.of(digest)})


def _digest(drive_id: str) -> str:
    origin = Origin.of_drive(drive_id)
    return origin.digest if origin else ""


def _replaced(
    there: abc.Mapping[str, str], origins: frozenset[Origin], name: str
) -> frozenset[Origin]:
    """Return what gives way: of a file of the same name all, else the drives that are the same."""
    same = {drive: Origin.of_drive(drive) for drive in there if is_from(drive, origins)}
    return frozenset(
        origin.file if origin.file in origins or there[drive] == name else origin
        for drive, origin in same.items()
        if origin is not None
    )


def _drives_of(warehouse: Warehouse, files: Collection[Origin]) -> dict[str, str]:
    """Return the drives that came in some files and are in the logs, and their `source_file`."""
    if not files:
        return {}
    query = (
        "SELECT drive_id, source_file FROM drives "
        "WHERE list_contains($digests, regexp_extract(drive_id, $measured, 1)) ORDER BY ALL"
    )
    given = {"digests": sorted({one.digest for one in files}), "measured": MEASURED}
    with connect_tables(warehouse, query) as database:
        return dict(database.execute(query, given).fetchall())


# A batch of files becomes data files.


class AskedFile(NamedTuple):
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Log
    earlier: str | None = None


@dataclass
class FileOutcome:
    """What one file became.

    Attributes:
        is_new: whether its content is not in the logs yet.
        left_out: drives that were forgotten.
        same: which files, and drives of others, have its fingerprints, whether still there or not.
        replaced: those that give way to it, and how many drives that are.
    """

    file: Log
    digest: str
    is_new: bool
    counts: IngestCounts
    suspicions: tuple[Fault, ...] = ()
    left_out: int = 0
    fingerprints: dict[str, int] = field(default_factory=dict)
    same: frozenset[Origin] = frozenset()
    replaced: frozenset[Origin] = frozenset()
    drives_replaced: int = 0


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    new: dict[TableName, NewFiles]

    @property
    def replaced(self) -> frozenset[Origin]:
        """What gives way to it."""
        return frozenset[Origin]().union(*(one.replaced for one in self.outcomes))

    @property
    def digest(self) -> str:
        """Digest of all files together."""
        return digest_of([outcome.digest for outcome in self.outcomes])


class _Batch:
    """Files that are written together."""

    def __init__(self, warehouse: Warehouse, files: Sequence[AskedFile]) -> None:
        self.warehouse, self.audit, self._number = warehouse, Audit(warehouse.root), len(files)
        self.forgotten = self.audit.begun()
        self.snapshot()
        self.files: dict[TableName, DataFiles] = {}

    def snapshot(self) -> None:
        """Look at the tables as they are now."""
        snapshots = {name: table.snapshot() for name, table in tables_of(self.warehouse).items()}
        self.logs = snapshots["logs"]
        self.landed = {name: one.landed_among(self._number) for name, one in snapshots.items()}

    def lacks(self, name: TableName, digest: str) -> bool:
        """Whether a file's rows are neither in a table nor about to be."""
        return digest not in self.files[name].digests and not self.landed[name](FILES + digest)


def write_batch(
    warehouse: Warehouse,
    mapping: Mapping,
    files: tuple[AskedFile, ...],
    progress: Progress = no_progress,
    replace: Replace = "no",
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own. Of what is new the longest drive is looked
    at for what looks wrong: one of a batch, since a folder of small files shall not be held up.
    `progress` counts bytes of each file.
    """
    batch = _Batch(warehouse, files)
    longest: tuple[FileOutcome, MeasuredDrive] | None = None
    outcomes: list[FileOutcome] = []
    failures: list[InputError] = []
    same = SameRecordings(warehouse, batch.logs, mapping.name, replace)
    copies = local_copies(asked.file for asked in files)
    with copies as open_copy, ThreadPoolExecutor(WRITERS) as threads:
        batch.files = {n: DataFiles(t, mapping, threads) for n, t in tables_of(warehouse).items()}
        for asked in files:
            try:
                with (
                    open_copy(asked.file) as file,
                    open_measured(file, mapping, progress) as stream,
                ):
                    first = drive_id(stream.prefix, 0)
                    if not batch.lacks("logs", stream.digest) and let_return(
                        warehouse, stream.digest, first
                    ):
                        batch.snapshot()
                    outcome, drive, rest = _write_file(stream, asked.file, batch)
                    if outcome.is_new:
                        earlier = asked.earlier
                        there = earlier and batch.landed["logs"](FILES + earlier)
                        same.judge(outcome, stream.name, earlier if there else None)
            except BaseException as error:
                for table in batch.files.values():
                    table.discard_log()
                if not isinstance(error, InputError):
                    raise
                failures.append(error)
                continue
            for name, table in batch.files.items():
                table.end_log(outcome.digest, rest.get(name, ()))
            outcomes.append(outcome)
            if drive and (longest is None or drive.ticks.size > longest[1].ticks.size):
                longest = outcome, drive
        for table in batch.files.values():
            table.write_waiting()
        if longest is not None:
            outcome, drive = longest
            outcome.suspicions += tuple(find_suspicions(signals_of(drive)))
        new = {name: table.finish() for name, table in batch.files.items()}
    return WrittenBatch(tuple(outcomes), tuple(failures), batch.forgotten, new)


def _write_file(
    stream: MeasuredStream, file: Log, batch: _Batch
) -> tuple[FileOutcome, MeasuredDrive | None, dict[TableName, Rows]]:
    """Read a file, write all but its last rows; return what it became, its longest drive, these."""
    digest, audit = stream.digest, batch.audit
    is_new = batch.lacks("logs", digest)
    lacking = {name for name in batch.files if is_new and batch.lacks(name, digest)}
    names = (f"measured-{digest[:24]}-{number}" for number in count(1))
    refused, rest = _RefusedRows(stream), dict[TableName, Rows]()
    longest: MeasuredDrive | None = None
    left_out, ticks = set[str](), 0
    fingerprints = {f"{PREFIX}{stream.content[:16]}": Origin.of(digest).number}
    for drives in _groups(_read_drives(stream, refused)):
        longest = max([*([longest] if longest else []), *drives], key=lambda one: one.ticks.size)
        kept = keep_drives(sorted(drives, key=lambda drive: drive.drive_id), audit)
        left_out |= {drive.drive_id for drive in drives} - {drive.drive_id for drive in kept}
        ticks += _rows_of(kept)
        for drive in kept if is_new else ():
            if origin := Origin.of_drive(drive.drive_id):
                fingerprints[f"{PREFIX}{drive.counts_digest}"] = origin.number
        if not kept or "logs" not in lacking:
            continue
        if _rows_of(drives) >= FILE_ROWS:
            batch.files["logs"].add(next(names), kept)
        else:
            rest["logs"] = kept
    for table, following in pairwise(chain(refused.tables(), [None])):
        allowed = keep_refused(table, audit, left_out)
        if not allowed.num_rows or "quarantine" not in lacking:
            continue
        if following is not None:
            batch.files["quarantine"].add(next(names), [allowed])
        else:
            rest["quarantine"] = [allowed]
    counts = stream.counts()
    outcome = FileOutcome(file, digest, is_new, counts)
    if not is_new:
        return outcome, None, {}
    outcome.counts = counts.without(len(left_out), ticks)
    outcome.left_out = len(left_out)
    outcome.suspicions = stream.suspicions()
    outcome.fingerprints = fingerprints if ticks else {}
    return outcome, longest, rest


def _read_drives(stream: MeasuredStream, refused: "_RefusedRows") -> Iterator[MeasuredDrive]:
    """Yield the drives of a file; keep its refused rows."""
    for piece in stream.pieces():
        refused.add(piece.refused)
        yield from piece.drives


def _groups(drives: Iterable[MeasuredDrive]) -> Iterator[list[MeasuredDrive]]:
    """Yield drives with as many rows as a data file has; the last ones may have fewer."""
    group: list[MeasuredDrive] = []
    for drive in drives:
        group.append(drive)
        if _rows_of(group) >= FILE_ROWS:
            yield group
            group = []
    if group:
        yield group


def _rows_of(drives: Iterable[MeasuredDrive]) -> int:
    return sum(drive.ticks.size for drive in drives)


class _RefusedRows:
    """Rows for the quarantine, spooled until it is known whether their drive was forgotten."""

    def __init__(self, stream: MeasuredStream) -> None:
        self._stream, self._spool = stream, Spool()
        self._rows: list[pl.DataFrame] = []

    def add(self, rows: pl.DataFrame) -> None:
        if rows.height:
            self._rows.append(rows)
        if sum(one.height for one in self._rows) >= FILE_ROWS:
            sink = pa.BufferOutputStream()
            with pa.ipc.new_stream(sink, QUARANTINE_SCHEMA) as writer:
                writer.write_table(self._stream.quarantine_table(self._rows))
            self._spool.add("", sink.getvalue().to_pybytes())
            self._rows = []

    def tables(self) -> Iterator[pa.Table]:
        for piece in self._spool.read(""):
            yield pa.ipc.open_stream(piece).read_all()
        if self._rows:
            yield self._stream.quarantine_table(self._rows)


# What was written is committed: refused rows, then drives.

TakeOut: TypeAlias = Callable[[TableName, Snapshot, Collection[Origin]], Change]
"""Returns what takes the drives of origins, or their refused rows, out of a table."""


def commit_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
    take_out: TakeOut | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit what was written of a batch; return it, and the units that are now in the logs.

    Where something was forgotten, or committed by another process, since it was written, `write`
    writes it again. What gives way to the new files is taken out in the same commits.
    """
    tables = tables_of(warehouse)

    def is_outdated(name: TableName, snapshot: Snapshot) -> bool:
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        if Audit(warehouse.root).begun() != written.forgotten:
            return True
        landed = snapshot.landed_among(len(written.new[name].units))
        if any(landed(unit.name) for unit in written.new[name].units):
            return True
        new = [one for one in written.outcomes if one.fingerprints] if name == "logs" else []
        known = Fingerprints(snapshot.units if new else {})
        return any(known.find(one.fingerprints) - one.same for one in new)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        while is_outdated(name, snapshot):
            for other, table in tables.items():
                table.discard(written.new[other].files)
            written = write()
            snapshot = tables[name].snapshot()
        new = written.new[name]
        gone = Change()
        if written.replaced and take_out and written.new["logs"].files:
            gone = take_out(name, snapshot, written.replaced)
        units = {unit.name: unit for unit in (*gone.units, *new.units)}
        for one in written.outcomes if name == "logs" else ():
            units |= {mark: Unit(mark, number) for mark, number in one.fingerprints.items()}
        if new.files or gone.remove:
            add = [*new.files, *gone.add]
            try:
                snapshot.commit(Change(add, gone.remove, tuple(units.values()), note))
            except ConflictError:
                tables[name].discard(gone.add)
                raise
        return frozenset(unit.name for unit in new.units) if new.files else frozenset()

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new
