"""The way of a batch of measured files into the warehouse, from an open file to the commit.

`write_batch` goes through the files of a batch, `_write_file` through the rows of one: what was
forgotten is left out, drives and refused rows become data files. `landing.committing` commits them.
"""

import json
import os
import re
from collections import abc
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from hashlib import sha256
from itertools import chain, count, groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.base import Progress, no_progress, number_of, shown
from fleet_slip.caches import cache_folder
from fleet_slip.catalogue.signals import as_arrow, catalogue
from fleet_slip.errors import ConflictError, InputError, RepeatedError
from fleet_slip.ingest.drives import MeasuredDrive, drive_id
from fleet_slip.ingest.log_files import LocalCopies, Log, Spool, StoredParts
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.preview import signals_of
from fleet_slip.ingest.stream import IngestCounts, MeasuredStream, open_measured
from fleet_slip.ingest.suspicion import Suspicion, find_suspicions
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.table import WITHDRAWN, Change, Snapshot, Table, Unit, retry_conflicts
from fleet_slip.warehouse.forgotten import ALLOWED, Audit, Forgettable
from fleet_slip.warehouse.tables import QUARANTINE_SCHEMA, Warehouse, connect_tables

# What of a file may land: all but the drives and the cars that were forgotten.


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
    """Return the refused rows that may land, where some drives of their file may not.

    A refused row goes with its car, or with the drive that it would have been of: the name of a
    drive that was cut at gaps in time begins with it.
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


# Recognises what is in the logs, by the bytes of a file or the counts of a drive.
#
# A mark is a unit of work beside that of its file, in the same commit: two processes that land the
# same drive at once are in conflict, and one of them is told. Its name is a digest, of all bytes
# of a file or of the counts of a drive; its number says of which content and drive:
#
#     40 bits of the content's digest | 3 bits: 0 of a file | 20 bits of the drive's name
#
# Names of cars and drives do not follow from it.

FILES, PREFIX = "ingest/", "same/"
DIGEST_CHARACTERS = 10
_DRIVE_BITS, _MARK_BITS = 20, 3
WHOLE_FILE = 0

MEASURED = rf"-([0-9a-f]{{{DIGEST_CHARACTERS}}})[0-9a-f]{{2}}((-[0-9]+){{1,2}})$"
"""What the name of a measured drive ends in: its file's digest, and which drive of it."""

_MEASURED = re.compile(MEASURED)


@dataclass(frozen=True, order=True)
class Origin:
    """What a mark is of: the first characters of a digest, and a drive's hash or the whole file."""

    digest: str
    drive: int = WHOLE_FILE

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

    @property
    def file(self) -> "Origin":
        """The file that it is, or is in."""
        return Origin(self.digest)


def mark_file(digest: str, content: str) -> dict[str, int]:
    """Return the mark of a file, by its digest and that of its bytes alone."""
    return {f"{PREFIX}{content[:16]}": _number(Origin.of(digest))}


def mark_drive(drive_id: str, counts_digest: str) -> dict[str, int]:
    """Return the mark of a measured drive."""
    origin = Origin.of_drive(drive_id)
    return {f"{PREFIX}{counts_digest}": _number(origin)} if origin else {}


class KnownMarks:
    """The marks of what is in the logs."""

    def __init__(self, units: abc.Mapping[str, int]) -> None:
        """Take the units of a snapshot of the logs."""
        self._numbers = {
            name: number
            for name, number in units.items()
            if name.startswith(PREFIX) and number != WITHDRAWN
        }
        self._files = {
            name.removeprefix(FILES)
            for name, number in units.items()
            if name.startswith(FILES) and number != WITHDRAWN
        }

    def find(self, marks: Iterable[str]) -> frozenset[Origin]:
        """Return which files, and which drives of others, have the same marks."""
        return frozenset(
            _origin(number) for mark in marks if (number := self._numbers.get(mark)) is not None
        )

    def withdraw(self, origins: Collection[Origin], files: Collection[Origin]) -> list[Unit]:
        """Return what withdraws the marks of origins, and files themselves that are all gone."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (origin := _origin(number)) in origins or origin.file in files
        ]
        of_files = [f"{FILES}{digest}" for digest in self._files if Origin.of(digest) in files]
        return [Unit(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def _number(origin: Origin) -> int:
    kind = int(origin.drive != WHOLE_FILE) << _DRIVE_BITS
    return int(origin.digest, 16) << (_MARK_BITS + _DRIVE_BITS) | kind | origin.drive


def _origin(number: int) -> Origin:
    digest = number >> (_MARK_BITS + _DRIVE_BITS)
    return Origin(f"{digest:0{DIGEST_CHARACTERS}x}", number % 2**_DRIVE_BITS)


# Writes rows of measured files to data files of bounded size. Nothing is committed.

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""

SHARED_ROWS = 2**14
"""Rows of a drive that share the memory of what is the same in all of them."""

TableName: TypeAlias = Literal["quarantine", "logs"]
Rows: TypeAlias = Sequence[MeasuredDrive] | Sequence[pa.Table]
"""Drives for the logs, or refused rows for the quarantine."""
Writing: TypeAlias = Future[list[AddAction]]

_POLARS_TYPES: dict[pa.DataType, type[pl.DataType] | pl.DataType] = {
    pa.string(): pl.String,
    pa.float64(): pl.Float64,
    pa.int64(): pl.Int64,
    pa.int32(): pl.Int32,
    pa.date32(): pl.Date,
    pa.timestamp("us", tz="UTC"): pl.Datetime("us", "UTC"),
}


@dataclass(frozen=True)
class Part:
    """Data files of one table that are not committed yet, and the units that land with them."""

    units: tuple[Unit, ...]
    files: tuple[AddAction, ...]


def unit_of(digest: str) -> Unit:
    """Return the unit of work that a file's content is."""
    return Unit(f"{FILES}{digest}", 1)


def digest_of(digests: Sequence[str]) -> str:
    """Return the digest of several files together."""
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


class DataFiles:
    """Data files of a batch in one table. Files are read one by one, and ended or discarded."""

    def __init__(
        self,
        table: Table,
        mapping: Mapping,
        threads: ThreadPoolExecutor,
        landed: Callable[[str], bool],
    ) -> None:
        """Take the table, the files' mapping, the threads, and what tells which units it has."""
        self._table, self._mapping, self._threads, self._landed = table, mapping, threads, landed
        self._begun: list[Writing] = []
        self._of_this: list[Writing] = []
        self._of_one: list[Writing] = []
        self._of_several: list[Writing] = []
        self._waiting: dict[str, Rows] = {}
        self._digests: list[str] = []

    def lacks(self, digest: str) -> bool:
        """Whether a file's rows are neither in the table nor about to be."""
        return digest not in self._digests and not self._landed(unit_of(digest).name)

    def add(self, name: str, rows: Rows) -> None:
        """Write rows of the file that is being read to a data file of their own."""
        self._of_this.append(self._begin(name, rows))

    def end_file(self, digest: str, rest: Rows) -> None:
        """End the file that is being read: the rest of its rows wait for those of others."""
        if self._of_this or rest:
            self._digests.append(digest)
        self._of_one += self._of_this
        self._of_this = []
        if rest:
            self._waiting[digest] = rest
        if sum(one.num_rows for rows in self._waiting.values() for one in rows) >= FILE_ROWS:
            self.write_waiting()

    def discard_file(self) -> None:
        """Delete what was written of the file that is being read."""
        written = [writing for writing in self._of_this if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())
        self._of_this = []

    def write_waiting(self) -> None:
        """Write rows in the order of their files' digests, and so of the names of drives."""
        digests = sorted(self._waiting)
        if digests:
            rows: Any = [one for digest in digests for one in self._waiting[digest]]
            name = f"measured-{digest_of(digests)[:24]}"
            self._of_several.append(self._begin(name, rows))
            self._waiting = {}

    def finish(self) -> Part:
        """Return all data files, written, and the units that they are."""
        self.write_waiting()
        writings = (*self._of_one, *self._of_several)
        files = tuple(file for writing in writings for file in writing.result())
        return Part(tuple(map(unit_of, sorted(self._digests))), files)

    def _begin(self, name: str, rows: Rows) -> Writing:
        """Write rows while the caller goes on; at most `WRITERS` files are under way."""
        if len(self._begun) >= WRITERS:
            self._begun[-WRITERS].result()
        self._begun.append(self._threads.submit(self._write, name, rows))
        return self._begun[-1]

    def _write(self, name: str, rows: Rows) -> list[AddAction]:
        parts = _by_day(_as_table(rows, self._mapping))
        encoded = {day: self._table.encode(part) for day, part in parts.items()}
        del parts  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def _as_table(rows: Rows, mapping: Mapping) -> pa.Table:
    """Return rows in one table."""
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
    sizes = [drive.ticks.size for drive in drives]
    columns = {}
    for column in catalogue().log_schema:
        if column.name == "tick":
            columns[column.name] = pa.chunked_array(
                [as_arrow(drive.ticks) for drive in drives], column.type
            )
        elif column.name in mapping.signal_names:
            columns[column.name] = pa.chunked_array([drive.counts[column.name] for drive in drives])
        elif column.name in catalogue().extras:
            continue
        elif column.name in catalogue().signals:
            absent = _shared(pa.nulls(SHARED_ROWS, column.type), sum(sizes))
            columns[column.name] = pa.chunked_array(absent, column.type)
        else:
            values = [drive.metadata.get(column.name) for drive in drives]
            columns[column.name] = _repeat(values, column.type, sizes)
    return pa.table(columns)


def _repeat(values: Sequence[Any], kind: pa.DataType, times: Sequence[int]) -> pa.ChunkedArray:
    """Return each value as often as it is told; texts as codes of a dictionary."""
    if pa.types.is_string(kind):
        texts = list(dict.fromkeys(text for text in values if text is not None))
        codes = {text: i for i, text in enumerate(texts)}
        repeated = _repeat([codes.get(text) for text in values], pa.int32(), times)
        named = _as_arrow(texts, kind)
        return pa.chunked_array(
            [pa.DictionaryArray.from_arrays(chunk, named, safe=False) for chunk in repeated.chunks],
            pa.dictionary(pa.int32(), kind),
        )
    runs = [
        (value, sum(number for _, number in run))
        for value, run in groupby(zip(values, times, strict=True), key=itemgetter(0))
    ]
    scalars = zip(_as_arrow([value for value, _ in runs], kind), runs, strict=True)
    chunks = [
        chunk
        for scalar, (_, number) in scalars
        for chunk in _shared(pa.repeat(scalar, min(number, SHARED_ROWS)), number)
    ]
    repeated = pa.chunked_array(chunks, kind)
    many_short_runs = len(runs) * SHARED_ROWS > sum(times)
    return pa.chunked_array([repeated.combine_chunks()]) if many_short_runs else repeated


def _shared(rows: pa.Array, number: int) -> list[pa.Array]:
    """Return so many rows that are all the same, in chunks of some that share their memory."""
    return [
        rows.slice(0, min(SHARED_ROWS, number - start)) for start in range(0, number, SHARED_ROWS)
    ]


def _as_arrow(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return values as Arrow has them; not by `pa.array`, which imports pandas if it is there."""
    return pl.Series(values, dtype=_POLARS_TYPES[kind]).to_arrow().cast(kind)


# Remembers which measured files of this machine have landed.
#
# What is remembered is a cache, of this machine and beside no data: a file's path, size and time of
# change tell its digest, so that thousands of files need not be read to find nothing new. Whether
# that digest is in the warehouse is asked of the warehouse. Losing the cache costs time, and the
# notice that a file has changed since it landed, so that its drives would count twice.

WITHDRAWALS = "withdrawals"
"""Unit of every commit that takes files out again, with a number that grows."""


@dataclass
class KnownFiles:
    """Which content the files of this machine had when they landed through a mapping.

    Attributes:
        digests: size, time of change (of an object, what the store calls its version) and
            digest, by absolute path or URL.
        landed: digests that are in the logs as they were at a moment: a version of the table, and
            the digest of its commit. While that commit is the table's, they need not be asked for.
    """

    cache: Path
    digests: dict[str, tuple[int, int | str, str]] = field(default_factory=dict)
    landed: set[str] = field(default_factory=set)
    moment: tuple[int, str] | None = None
    withdrawals: int | None = None
    """What the unit of them had as number at that moment: what has landed may be gone since."""

    @classmethod
    def of(cls, warehouse: Warehouse, mapping: Mapping) -> "KnownFiles":
        """Return what is remembered for a data root and a mapping."""
        about = sha256(f"{warehouse.root.uri}\n{mapping.canonical_json()}".encode()).hexdigest()
        cache = cache_folder("ingested") / f"{about[:32]}.json"
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            kept: dict[str, Any] = json.loads(cache.read_bytes())
            if "files" not in kept:  # of an earlier version, which remembered no moment
                kept = {"files": kept, "landed": [], "moment": (0, "")}
            files = {path: (int(s), t, str(d)) for path, (s, t, d) in kept["files"].items()}
            version, commit = kept["moment"]
            moment = int(version), str(commit)
            return cls(cache, files, set(kept["landed"]), moment, kept.get("withdrawals"))
        return cls(cache)

    def without_landed(self, files: Iterable[Log], warehouse: Warehouse) -> list[Log]:
        """Return the files that are not in the logs, as far as size and time of change tell."""
        snapshot = warehouse.logs.snapshot()
        if self.moment is None or snapshot.moment(self.moment[0]) != self.moment[1]:
            self.landed.clear()  # another table, or one that was restored
        self._forget_withdrawn(snapshot)
        landed = snapshot.landed_among(len(self.digests))
        return [file for file in files if not self._has_landed(file, landed)]

    def _forget_withdrawn(self, snapshot: Snapshot) -> None:
        if self.moment and snapshot.version == self.moment[0]:
            return
        if (withdrawals := snapshot.landed(WITHDRAWALS)) != self.withdrawals:
            self.landed.clear()
        self.withdrawals = withdrawals

    def _has_landed(self, file: Log, landed: Callable[[str], bool]) -> bool:
        known = self.digests.get(_name_of(file))
        if known is None or _state_of(file) != known[:2]:
            return False
        return known[2] in self.landed or landed(unit_of(known[2]).name)

    def digest_of(self, file: Log) -> str | None:
        """Return the digest of what a path had when it landed, None if it never did."""
        known = self.digests.get(_name_of(file))
        return None if known is None else known[2]

    def remember(self, file: Log, digest: str) -> None:
        """Keep in mind that a file has landed."""
        if state := _state_of(file):
            self.digests[_name_of(file)] = (*state, digest)

    def save(self, warehouse: Warehouse) -> None:
        """Write the cache; what cannot be written is not kept."""
        snapshot = warehouse.logs.snapshot()
        self._forget_withdrawn(snapshot)
        asked = {digest for _, _, digest in self.digests.values()}
        has_landed = snapshot.landed_among(len(asked))
        self.landed = {d for d in asked if d in self.landed or has_landed(unit_of(d).name)}
        version = snapshot.version or 0
        kept = {
            "files": self.digests,
            "landed": sorted(self.landed),
            "moment": [version, snapshot.moment(version)],
            "withdrawals": self.withdrawals,
        }
        with suppress(OSError):
            self.cache.parent.mkdir(parents=True, exist_ok=True)
            draft = self.cache.with_suffix(f".{os.getpid()}")
            draft.write_text(json.dumps(kept))
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


# Decides what becomes of a file whose recording is in the logs already.

Replace: TypeAlias = Literal["no", "corrected", "all"]
"""Which recordings that are there give way to the same ones: those of the same file through a
mapping of the same name that has been changed since are `corrected`."""


@dataclass(frozen=True)
class RecordingInLogs:
    """What the logs have of a file's recording.

    Attributes:
        origins: as its marks tell, whether its drives are still there or not.
        replaced: those that give way to it, and how many `drives` that are.
    """

    origins: frozenset[Origin] = frozenset()
    replaced: frozenset[Origin] = frozenset()
    drives: int = 0


class SameRecordings:
    """Looks for the recordings of a batch of files, in the logs and in the batch."""

    def __init__(
        self, warehouse: Warehouse, logs: Snapshot, mapping: str, replace: Replace
    ) -> None:
        """Take a snapshot of the logs, the mapping's name, and what is to give way."""
        self._warehouse, self._logs = warehouse, logs
        self._mapping, self._replace = mapping, replace
        self._batch: dict[str, int] = {}
        self._files: dict[str, Log] = {}

    @cached_property
    def _known(self) -> KnownMarks:
        return KnownMarks(self._logs.units)

    def judge(
        self, file: Log, name: str, digest: str, marks: abc.Mapping[str, int], earlier: str | None
    ) -> RecordingInLogs:
        """Return what the logs have of a file.

        `name` is the file's as `source_file` has it; `earlier` is the digest of what its path had
        before, if that landed. Raises `RepeatedError` for what does not give way to it.
        """
        for origin in KnownMarks(self._batch).find(marks):  # the same bytes count once anyway
            other = shown(self._files[origin.digest])
            raise RepeatedError(
                f"{shown(file)}: it has the recording of {other}, which is ingested with it. "
                "Leave one of them out."
            )
        origins = self._known.find(marks)
        changed = earlier is not None and earlier != digest
        if earlier is not None and changed:
            origins |= {Origin.of(earlier)}
        there = _drives_of(self._warehouse, {one.file for one in origins})
        replaced = _replaced(there, origins, name)
        drives = [drive for drive in there if is_from(drive, replaced)]
        gives_way = self._replace == "all" or (
            self._replace == "corrected"
            and not changed
            and replaced <= {one.file for one in origins} & origins
            and all(drive.startswith(f"{self._mapping}-{_digest(drive)}") for drive in drives)
        )
        if drives and not gives_way:
            raise RepeatedError(_sentence(file, drives, there, changed=changed))
        self._batch.update(marks)
        self._files[Origin.of(digest).digest] = file
        return RecordingInLogs(origins, replaced if drives else frozenset(), len(drives))


def let_return(warehouse: Warehouse, digest: str, first_drive: str) -> bool:
    """Withdraw a file of which no drive is left, and whose first one may come back; say if so.

    Only what was forgotten by a drive's or a file's name may: what is too old stays away.
    """
    audit = Audit(warehouse.root)
    if not audit.allows_drives or audit.state(Forgettable("drive", first_drive)) != ALLOWED:
        return False

    def attempt(table: Table, *others: Unit) -> None:
        snapshot = table.snapshot()
        if _drives_of(warehouse, {Origin.of(digest)}):
            return
        if snapshot.landed(f"{FILES}{digest}") not in {None, WITHDRAWN}:
            units = (Unit(f"{FILES}{digest}", WITHDRAWN), *others)
            snapshot.commit(Change(units=units, note={"job": "undo"}))

    retry_conflicts(lambda: attempt(warehouse.quarantine))
    version = warehouse.logs.snapshot().version or 0
    retry_conflicts(lambda: attempt(warehouse.logs, Unit(WITHDRAWALS, version + 1)))
    return True


def are_gone(warehouse: Warehouse, digest: str) -> bool:
    """Whether drives were forgotten, and none is left that came in a file that has landed."""
    return bool(Audit(warehouse.root).entries()) and not _drives_of(warehouse, {Origin.of(digest)})


def is_from(drive_id: str, origins: Collection[Origin]) -> bool:
    """Whether a drive is one of some, or came in a file of theirs."""
    origin = Origin.of_drive(drive_id)
    return origin is not None and (origin in origins or origin.file in origins)


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


def _sentence(file: Log, drives: list[str], there: abc.Mapping[str, str], *, changed: bool) -> str:
    """Say what is there of a file, and what to do."""
    source = shown(there[drives[0]])
    what = "it has changed since it was ingested" if changed else "its recording is in the logs"
    such = drives[0] if len(drives) == 1 else f"{number_of(len(drives), 'drive')}, {drives[0]} …"
    return (
        f"{shown(file)}: {what}, and would count twice: {such} from {source}. To put this in its "
        "place, give the command again with --replace; to take the old one out: fleet-slip ingest "
        f"--undo {source}"
    )


@dataclass(frozen=True)
class AskedFile:
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Log
    earlier: str | None = None


@dataclass
class FileOutcome:
    """What one file became.

    Attributes:
        is_new: whether its drives had not landed.
        vehicles: the cars of what lands; `left_out` are drives that do not, as forgotten.
    """

    file: Log
    digest: str
    is_new: bool
    counts: IngestCounts
    look_alikes: tuple[tuple[str, ...], ...]
    suspicions: tuple[Suspicion, ...] = ()
    vehicles: set[str] = field(default_factory=set)
    left_out: int = 0
    marks: dict[str, int] = field(default_factory=dict)
    found: RecordingInLogs = field(default_factory=RecordingInLogs)


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    outcomes: tuple[FileOutcome, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    parts: dict[TableName, Part]

    @property
    def replaced(self) -> frozenset[Origin]:
        """What gives way to it."""
        return frozenset[Origin]().union(*(one.found.replaced for one in self.outcomes))

    @property
    def digest(self) -> str:
        """Digest of what landed first time, of all files together."""
        return digest_of([outcome.digest for outcome in self.outcomes])


def write_batch(
    warehouse: Warehouse,
    mapping: Mapping,
    files: tuple[AskedFile, ...],
    progress: Progress = no_progress,
    replace: Replace = "no",
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own, and nothing of it is written. What landed
    before is not written again, nor a recording that is there, unless that is to give way. The
    longest drive of what is new is looked at: one of a batch, so that a folder of small files is
    not held up. `progress` counts bytes of each file.
    """
    audit = Audit(warehouse.root)
    forgotten = audit.begun()
    longest: tuple[FileOutcome, MeasuredDrive] | None = None
    outcomes: list[FileOutcome] = []
    failures: list[InputError] = []
    snapshots = {name: table.snapshot() for name, table in tables_of(warehouse).items()}
    landed = {name: one.landed_among(len(files)) for name, one in snapshots.items()}
    same = SameRecordings(warehouse, snapshots["logs"], mapping.name, replace)
    copies = LocalCopies(asked.file for asked in files)
    with copies, ThreadPoolExecutor(WRITERS) as threads:
        tables = {
            name: DataFiles(table, mapping, threads, partial(_has_landed, landed, name))
            for name, table in tables_of(warehouse).items()
        }
        for asked in files:
            try:
                with (
                    copies.of(asked.file) as file,
                    open_measured(file, mapping, progress) as stream,
                ):
                    if not tables["logs"].lacks(stream.digest) and let_return(
                        warehouse, stream.digest, drive_id(stream.prefix, 0)
                    ):
                        for name, stored in tables_of(warehouse).items():
                            landed[name] = stored.snapshot().landed_among(len(files))
                    outcome, drive, rest = _write_file(stream, asked.file, tables, audit)
                    if outcome.is_new:
                        earlier = asked.earlier
                        if earlier and not landed["logs"](unit_of(earlier).name):
                            earlier = None
                        outcome.found = same.judge(
                            asked.file, stream.name, stream.digest, outcome.marks, earlier
                        )
            except BaseException as error:
                for table in tables.values():
                    table.discard_file()
                if not isinstance(error, InputError):
                    raise
                failures.append(error)
                continue
            for name, table in tables.items():
                table.end_file(outcome.digest, rest.get(name, ()))
            outcomes.append(outcome)
            if drive and (longest is None or drive.ticks.size > longest[1].ticks.size):
                longest = outcome, drive
        for table in tables.values():
            table.write_waiting()
        if longest is not None:
            outcome, drive = longest
            outcome.suspicions += tuple(find_suspicions(signals_of(drive)))
        parts = {name: table.finish() for name, table in tables.items()}
    return WrittenBatch(tuple(outcomes), tuple(failures), forgotten, parts)


def _has_landed(landed: dict[TableName, Callable[[str], bool]], name: TableName, unit: str) -> bool:
    return landed[name](unit)


def _write_file(
    stream: MeasuredStream,
    file: Log,
    tables: dict[TableName, DataFiles],
    audit: Audit,
) -> tuple[FileOutcome, MeasuredDrive | None, dict[TableName, Rows]]:
    """Read a file, write all but its last rows; return what it became, its longest drive, these."""
    is_new = tables["logs"].lacks(stream.digest)
    lacking = {n for n, table in tables.items() if is_new and table.lacks(stream.digest)}
    names = (f"measured-{stream.digest[:24]}-{number}" for number in count(1))
    refused, rest = _RefusedRows(stream), dict[TableName, Rows]()
    longest: MeasuredDrive | None = None
    left_out, vehicles, ticks = set[str](), set[str](), 0
    marks = mark_file(stream.digest, stream.content)
    for drives in _groups(_read_drives(stream, refused)):
        longest = max([*([longest] if longest else []), *drives], key=lambda one: one.ticks.size)
        kept = keep_drives(sorted(drives, key=lambda drive: drive.drive_id), audit)
        left_out |= {drive.drive_id for drive in drives} - {drive.drive_id for drive in kept}
        vehicles |= set(map(car_of, kept))
        ticks += _rows_of(kept)
        for drive in kept if is_new else ():
            marks |= mark_drive(drive.drive_id, drive.counts_digest)
        if not kept or "logs" not in lacking:
            continue
        if _rows_of(drives) >= FILE_ROWS:
            tables["logs"].add(next(names), kept)
        else:
            rest["logs"] = kept
    for table, following in pairwise(chain(refused.tables(), [None])):
        allowed = keep_refused(table, audit, left_out)
        vehicles |= names_in(allowed, "vehicle_id")
        if not allowed.num_rows or "quarantine" not in lacking:
            continue
        if following is not None:
            tables["quarantine"].add(next(names), [allowed])
        else:
            rest["quarantine"] = [allowed]
    counts = stream.counts()
    outcome = FileOutcome(file, stream.digest, is_new, counts, stream.look_alikes())
    if not is_new:
        return outcome, None, {}
    outcome.counts = counts.without(len(left_out), ticks)
    outcome.vehicles, outcome.left_out = vehicles, len(left_out)
    outcome.suspicions = stream.suspicions()
    if ticks:
        outcome.marks = marks
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


def tables_of(warehouse: Warehouse) -> dict[TableName, Table]:
    """Return the tables that files land in, in the order in which they are committed."""
    return {"quarantine": warehouse.quarantine, "logs": warehouse.logs}


def _rows_of(drives: Iterable[MeasuredDrive]) -> int:
    return sum(drive.ticks.size for drive in drives)


# Commits what was written of a batch: refused rows, then drives.


class Superseding(Protocol):
    """Takes out of a table what gives way to new files, in the commit that lands these."""

    def without(self, name: TableName, snapshot: Snapshot, origins: Collection[Origin]) -> Change:
        """Return what takes drives, or their refused rows, out of a table; files are written."""
        ...


def land_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
    superseding: Superseding | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit what was written of a batch; return it, and the units that are now in the logs.

    Where something was forgotten, or landed by another process, since it was written, `write`
    writes it again. Each table's files are one commit, with a note: refused rows, then drives; and
    what gives way to them goes in the same commits.
    """
    tables = tables_of(warehouse)

    def is_outdated(name: TableName, snapshot: Snapshot) -> bool:
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        if Audit(warehouse.root).begun() != written.forgotten:
            return True
        landed = snapshot.landed_among(len(written.parts[name].units))
        if any(landed(unit.name) for unit in written.parts[name].units):
            return True
        new = [one for one in written.outcomes if one.marks] if name == "logs" else []
        known = KnownMarks(snapshot.units if new else {})
        return any(known.find(one.marks) - one.found.origins for one in new)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        while is_outdated(name, snapshot):
            for other, table in tables.items():
                table.discard(written.parts[other].files)
            written = write()
            snapshot = tables[name].snapshot()
        part = written.parts[name]
        gone = Change()
        if written.replaced and superseding and written.parts["logs"].files:
            gone = superseding.without(name, snapshot, written.replaced)
        marks = [mark for one in written.outcomes for mark in one.marks.items()]
        units = {unit.name: unit for unit in (*gone.units, *part.units)}
        if name == "logs":
            units |= {mark: Unit(mark, number) for mark, number in marks}
        if part.files or gone.remove:
            add = [*part.files, *gone.add]
            try:
                snapshot.commit(Change(add, gone.remove, tuple(units.values()), note))
            except ConflictError:
                tables[name].discard(gone.add)
                raise
        return frozenset(unit.name for unit in part.units) if part.files else frozenset()

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new
