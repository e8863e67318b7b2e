"""Brings measured logs into the warehouse; the same file through the same mapping lands once.

`ingest_files` goes through batches of logs: `write_batch` reads each log and writes data files,
`commit_batch` commits these.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.arrays import IntArray
from fleet_slip.base import Record, pluralize
from fleet_slip.catalog.signals import SignalCatalog, as_arrow
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import ConfigError, ConflictError, InputError, RepeatedError
from fleet_slip.ingest.drives import MeasuredDrive, drive_id
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.recordings import (
    FILES,
    PREFIX,
    DuplicateDetector,
    Fingerprints,
    IngestCache,
    Replace,
    SourceRef,
    TableName,
    digest_of,
    drop_erased_drives,
    drop_erased_rejects,
    file_transaction,
    fingerprints_of,
    is_fully_erased,
    readmit_file,
    size_of,
    tables_of,
)
from fleet_slip.ingest.stream import IngestCounts, MeasuredStream, open_measured
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.plausibility import Signals, check_plausibility, to_regular_grid
from fleet_slip.rendering import Answer, Part, TextTable
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, Table, retry_conflicts
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.warehouse import Warehouse

BATCH_BYTES = 2**24
"""Files are read, written and committed together up to this size."""
BATCH_FILES = 500
FAILURES_SHOWN = 5


class IngestTask(NamedTuple):
    """A file to ingest, and the digest of what this very path had when it was ingested before."""

    file: Path
    earlier: str | None = None


Batch: TypeAlias = tuple[IngestTask, ...]
BuildRemoval: TypeAlias = Callable[[TableName, Snapshot, Collection[SourceRef]], Change]
"""Returns what takes the drives of origins, or their refused rows, out of a table."""


@dataclass
class FileReport(Record):
    """What a file became, and what looks wrong in it."""

    file: str
    counts: IngestCounts
    suspicions: tuple[Fault, ...] = ()
    """In the file as a whole; and in the longest drive of all files that are read together."""

    @property
    def alarms(self) -> tuple[Fault, ...]:
        """What looks wrong and does harm."""
        return tuple(one for one in self.suspicions if one.does_harm)


@dataclass
class IngestReport(FileReport):
    """What became of one file."""

    DOCUMENT = "file new *counts rows_quarantined drives_forgotten drives_replaced suspicions"

    new: bool = True
    drives_forgotten: int = 0
    """Drives that were left out: of cars that were forgotten, or forgotten themselves."""
    drives_replaced: int = 0
    """Drives that gave way to it: its recording, from another file or through another mapping."""

    @property
    def rows_quarantined(self) -> int:
        """How many rows were refused."""
        return sum(self.counts.quarantined.values())


@dataclass(frozen=True)
class SignalRange:
    """The values of a signal in a file, in the catalog's unit."""

    signal: str
    unit: str
    low: float
    high: float
    missing: float
    """Part of the ticks without a value."""


@dataclass
class Preview(FileReport, Answer):
    """What would become of a file."""

    DOCUMENT = "file *counts ranges suspicions"

    ranges: tuple[SignalRange, ...] = ()

    def parts(self) -> Iterator[Part]:
        """Return how many rows are taken, a table of the signals, and what looks wrong."""
        counts = self.counts
        rejected = ", ".join(f"{n:,} {reason}" for reason, n in counts.quarantined.items())
        yield TextTable(
            f"{self.file}: {pluralize(counts.rows_read, 'row')}; left out by conditions "
            f"{counts.rows_left_out:,}; rejected {sum(counts.quarantined.values()):,}"
            f"{f' ({rejected})' if rejected else ''}; {pluralize(counts.drives, 'drive')} of "
            f"{pluralize(counts.ticks, 'tick')}",
            "signal|unit|least|most|missing",
            self.ranges,
            "{signal}|{unit}|{low:.4g}|{high:.4g}|{missing:.1%}",
            left=2,
        )
        yield from (f"looks wrong: {one}" for one in self.suspicions)


@dataclass
class WrittenFile:
    """What one file of a batch became: its report, and by what it is recognised.

    Attributes:
        same: which files, and drives of others, have its fingerprints, whether still there or not.
        replaced: those that give way to it.
    """

    log: Path
    digest: str
    report: IngestReport
    fingerprints: dict[str, int] = field(default_factory=dict)
    same: frozenset[SourceRef] = frozenset()
    replaced: frozenset[SourceRef] = frozenset()


class NewFiles(NamedTuple):
    """Data files of one table that are not committed yet, and their transactions."""

    transactions: tuple[AppTransaction, ...]
    files: tuple[AddAction, ...]


@dataclass(frozen=True)
class WrittenBatch:
    """What a batch of files became; `forgotten` are the entries that its drives were judged by."""

    files: tuple[WrittenFile, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    new: dict[TableName, NewFiles]

    @property
    def replaced(self) -> frozenset[SourceRef]:
        """What gives way to it."""
        return frozenset[SourceRef]().union(*(one.replaced for one in self.files))


def ingest_files(
    warehouse: Warehouse,
    files: Iterable[Path],
    mapping: Mapping,
    executor: Executor | None = None,
    known: IngestCache | None = None,
    replace: Replace = "no",
    build_removal: BuildRemoval | None = None,
) -> Iterator[IngestReport]:
    """Ingest files, and yield a report of each as it is committed; small files land together.

    An executor's workers read batches in any order, but its threads none of large files, each of
    which keeps all cores busy. `known` remembers what is in. A recording that is there is refused,
    unless it is to be replaced: then `build_removal` takes it out in the same commit.

    At the end raises `InputError`, which names all files that cannot be used, or `RepeatedError`
    where all of these are there already; `ClusterError` for files that workers died of; and
    `ConfigError` for a mapping of other signals.
    """
    if mapping.signal_catalog != warehouse.catalog.signals:  # counts would have another scale
        raise ConfigError(
            f"the mapping {mapping.name!r} was loaded with other signals than those of "
            f"{warehouse.root}. Load it with the configs of this data root."
        )
    write = partial(write_batch, warehouse, mapping, replace=replace)
    warehouse.logs.require_writable(mapping.signal_names)
    failures: list[InputError] = []
    asked = (IngestTask(file, known.digest_of(file) if known else None) for file in files)
    for batch, written in _written(executor, write, _batches(asked)):
        # Not the file's name: it may name a car, and the Delta log outlives what is forgotten.
        digest = digest_of([one.digest for one in written.files])
        note = {"job": "ingest", "mapping": mapping.name, "digest": digest}
        committed, new = commit_batch(
            warehouse, written, partial(write, batch), note, build_removal
        )
        failures += committed.failures
        for one in committed.files:
            transaction = file_transaction(one.digest).name
            yield _finished(warehouse, one, is_new=transaction in new)
            new -= {transaction}  # the same content in another file is not new
            if known is not None:
                known.remember(one.log, one.digest)
    if failures:
        raise _joined(failures)


def _written(
    executor: Executor | None, write: Callable[[Batch], WrittenBatch], batches: Iterable[Batch]
) -> Iterator[tuple[Batch, WrittenBatch]]:
    """Yield batches as they are written."""
    alone: list[Batch] = []
    if isinstance(executor, ThreadPoolExecutor):
        together: list[Batch] = []
        for batch in batches:
            (alone if size_of(batch[0].file) >= BATCH_BYTES else together).append(batch)
        batches = together
    yield from run_tasks(executor, write, batches, lambda batch: str(batch[0].file))
    yield from ((batch, write(batch)) for batch in alone)


def _batches(files: Iterable[IngestTask]) -> Iterator[Batch]:
    """Group files, in their order, into batches of `BATCH_BYTES` and one file at least."""
    batch: list[IngestTask] = []
    size = 0
    for asked in files:
        more = size_of(asked.file)
        if batch and (size + more > BATCH_BYTES or len(batch) >= BATCH_FILES):
            yield tuple(batch)
            batch, size = [], 0
        batch.append(asked)
        size += more
    if batch:
        yield tuple(batch)


def _finished(warehouse: Warehouse, one: WrittenFile, *, is_new: bool) -> IngestReport:
    """Return the report of a file, once it is known whether this process has committed it."""
    report = one.report
    report.new = is_new
    if not is_new:
        report.suspicions, report.drives_replaced = (), 0
        if not report.drives_forgotten and is_fully_erased(warehouse, one.digest):
            report.drives_forgotten = report.counts.drives
            report.counts = dataclasses.replace(report.counts, drives=0, ticks=0)
    return report


def _joined(failures: list[InputError]) -> InputError:
    """Return one error that names all."""
    if len(failures) == 1:
        return failures[0]
    first = " ".join(map(str, failures[:FAILURES_SHOWN]))
    more = len(failures) - FAILURES_SHOWN
    kind = RepeatedError if all(isinstance(o, RepeatedError) for o in failures) else InputError
    return kind(
        f"{pluralize(len(failures), 'file')} cannot be used; all others are stored. {first}"
        + (f" And {more:,} more." if more > 0 else "")
    )


# A batch of files becomes data files.

FILE_ROWS = 2**18
"""A data file is written as soon as it has so many rows; its last drive may make it larger."""


def write_batch(
    warehouse: Warehouse, mapping: Mapping, files: Batch, replace: Replace = "no"
) -> WrittenBatch:
    """Read files, and write their rows together: one data file a day. Nothing is committed.

    A file that cannot be used is a failure of its own.
    """
    failures: list[InputError] = []
    written: list[WrittenFile] = []
    longest: list[tuple[FileReport, MeasuredDrive | None]] = []
    with ThreadPoolExecutor(WRITERS) as writers:
        batch = _Writer(warehouse, mapping, files, writers, replace)
        for asked in files:
            try:
                with open_measured(asked.file, mapping) as stream:
                    one = batch.write(stream, asked)
            except BaseException as error:
                for data in batch.data.values():
                    data.discard_log()
                if not isinstance(error, InputError):
                    raise
                failures.append(error)
            else:
                for data in batch.data.values():
                    data.end_log()
                written.append(one)
                if one.report.new:
                    longest.append((one.report, stream.longest))
        _judge_longest(mapping.signal_catalog, longest)
        new = {name: data.finish() for name, data in batch.data.items()}
    return WrittenBatch(tuple(written), tuple(failures), batch.forgotten, new)


def _judge_longest(
    signals: SignalCatalog, results: Iterable[tuple[FileReport, MeasuredDrive | None]]
) -> None:
    """Add what looks wrong in the longest drive of files to the report of its file.

    It stands for all, since to look at a drive takes longer than to load a small file.
    """
    drives = [(report, drive) for report, drive in results if drive is not None]
    if drives:
        report, drive = max(drives, key=lambda pair: pair[1].ticks.size)
        report.suspicions += tuple(check_plausibility(signals, signals_of(signals, drive)))


class _Writer:
    """Writes files together."""

    def __init__(
        self,
        warehouse: Warehouse,
        mapping: Mapping,
        files: Batch,
        writers: ThreadPoolExecutor,
        replace: Replace,
    ) -> None:
        self.warehouse, self.erasure_log, self.mapping = (
            warehouse,
            ErasureLog(warehouse.root),
            mapping,
        )
        self.forgotten, self._number = self.erasure_log.begun(), len(files)
        logs = self._look()
        self.data = {name: DataFiles(t, writers) for name, t in tables_of(warehouse).items()}
        self._same = DuplicateDetector(warehouse, logs, mapping.name, replace)

    def _look(self) -> Snapshot:
        """Look at the tables as they are now; return a snapshot of the logs."""
        snapshots = {name: table.snapshot() for name, table in tables_of(self.warehouse).items()}
        self._landed = {name: one.landed_among(self._number) for name, one in snapshots.items()}
        return snapshots["logs"]

    def _lacks(self, name: TableName, digest: str) -> bool:
        """Whether a file's rows are neither in a table nor about to be."""
        return digest not in self.data[name].digests and not self._landed[name](FILES + digest)

    def write(self, stream: MeasuredStream, asked: IngestTask) -> WrittenFile:
        """Read a file, and write all but its last rows, which wait; return what it became.

        Raises `InputError`, and `RepeatedError` for a recording that is in the logs.
        """
        digest, first_drive = stream.digest, drive_id(stream.prefix, 0)
        if not self._lacks("logs", digest) and readmit_file(self.warehouse, digest, first_drive):
            self._look()
        is_new = self._lacks("logs", digest)
        for name, data in self.data.items():
            data.begin_log(digest, wanted=is_new and self._lacks(name, digest))
        fingerprints = {f"{PREFIX}{stream.content[:16]}": SourceRef.of(digest).number}
        left_out, ticks = set[str](), 0
        for drives in _groups(stream.drives()):
            kept = drop_erased_drives(
                sorted(drives, key=lambda drive: drive.drive_id), self.erasure_log
            )
            left_out |= {drive.drive_id for drive in drives} - {drive.drive_id for drive in kept}
            ticks += _rows_of(kept)
            if is_new and kept:
                full = _rows_of(drives) >= FILE_ROWS
                self.data["logs"].add(log_table(kept, self.mapping), full=full)
                fingerprints |= fingerprints_of(kept)
        for table, following in pairwise(chain(stream.quarantine(), [None])):
            allowed = drop_erased_rejects(table, self.erasure_log, left_out)
            self.data["quarantine"].add(allowed, full=following is not None)
        report = IngestReport(str(asked.file), stream.counts, new=is_new)
        one = WrittenFile(asked.file, digest, report)
        if is_new:
            report.drives_forgotten, report.suspicions = len(left_out), stream.suspicions()
            drives_left = stream.counts.drives - len(left_out)
            report.counts = dataclasses.replace(stream.counts, drives=drives_left, ticks=ticks)
            one.fingerprints = fingerprints if ticks else {}
            is_there = asked.earlier and self._landed["logs"](FILES + asked.earlier)
            earlier = asked.earlier if is_there else None
            found = self._same.find(asked.file, digest, one.fingerprints, stream.name, earlier)
            one.same, one.replaced, report.drives_replaced = found
        return one


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


# What would become of files: they are read as above, and nothing is written.


def preview_logs(logs: Iterable[Path], mapping: Mapping) -> list[Preview]:
    """Read logs as `ingest_files` does, with the same verdict; store nothing.

    Raises `InputError`.
    """
    previews: list[Preview] = []
    for batch in _batches(map(IngestTask, logs)):
        results = [preview_log(task.file, mapping) for task in batch]
        _judge_longest(mapping.signal_catalog, results)
        previews += [preview for preview, _ in results]
    return previews


def preview_log(log: Path, mapping: Mapping) -> tuple[Preview, MeasuredDrive | None]:
    """Return what would become of a log, and its longest drive. Raises `InputError`."""
    ends: dict[str, list[int]] = {name: [] for name in mapping.signal_names}
    values: Counter[str] = Counter()
    with open_measured(log, mapping) as stream:
        for drive in stream.drives():
            for name, counts in drive.counts.items():
                values[name] += len(counts) - counts.null_count
                found = pc.min_max(counts).as_py()
                ends[name] += [] if found["min"] is None else [found["min"], found["max"]]
        of_rows = stream.suspicions()  # which may look into the file again
    ranges = []
    for name, some in ends.items():
        signal = mapping.signal_catalog[name]
        scale = float(signal.scale)
        low, high = (scale * min(some), scale * max(some)) if some else (np.nan, np.nan)
        missing = 1 - values[name] / max(stream.counts.ticks, 1)
        ranges.append(SignalRange(name, signal.unit, low, high, missing))
    return Preview(str(log), stream.counts, of_rows, tuple(ranges)), stream.longest


MOST_TICKS = 200_000
"""Ticks of the longest drive that are looked at: half an hour."""


def signals_of(signals: SignalCatalog, drive: MeasuredDrive) -> Signals:
    """Return the signals of the beginning of a drive, as `check_plausibility` takes them."""
    selected = drive.ticks - drive.ticks[0] < MOST_TICKS
    counts = {  # by Polars: Arrow's own would load pandas
        name: pl.Series(values).cast(pl.Float64).fill_null(float("nan")).to_numpy()[selected]
        for name, values in drive.counts.items()
    }
    return to_regular_grid(signals, drive.ticks[selected], counts)


# Data files of bounded size. Nothing is committed yet.

WRITERS = 2
"""Data files that are written at once: encoding them is the longest part of an ingest."""


class DataFiles:
    """Data files of a batch in one table. Logs are begun one by one, and ended or discarded."""

    def __init__(self, table: Table, threads: ThreadPoolExecutor) -> None:
        """Take the table, and threads to write with."""
        self._table, self._threads = table, threads
        self._written: list[Future[list[AddAction]]] = []
        self._of_this_log: list[Future[list[AddAction]]] = []
        self._waiting: dict[str, pa.Table] = {}
        self.digests: list[str] = []

    def begin_log(self, digest: str, *, wanted: bool) -> None:
        """Begin a log, whose rows are passed over unless they are wanted."""
        self._digest, self._is_wanted = digest, wanted
        self._rest: pa.Table | None = None

    def add(self, rows: pa.Table, *, full: bool) -> None:
        """Write rows of the log to a data file of their own if they are enough to fill it."""
        if self._is_wanted and rows.num_rows:
            if full:
                name = f"measured-{self._digest[:24]}-{len(self._of_this_log) + 1}"
                self._of_this_log.append(self._begin(name, [rows]))
            else:
                self._rest = rows

    def end_log(self) -> None:
        """End the log: the rest of its rows wait for those of others."""
        if self._of_this_log or self._rest is not None:
            self.digests.append(self._digest)
        self._written += self._of_this_log
        self._of_this_log = []
        if self._rest is not None:
            self._waiting[self._digest] = self._rest
        if sum(rows.num_rows for rows in self._waiting.values()) >= FILE_ROWS:
            self._write_waiting()

    def discard_log(self) -> None:
        """Delete what was written of the log that is being read."""
        written = [writing for writing in self._of_this_log if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())
        self._of_this_log = []

    def finish(self) -> NewFiles:
        """Return all data files, written, and their transactions."""
        self._write_waiting()
        files = tuple(file for writing in self._written for file in writing.result())
        return NewFiles(tuple(map(file_transaction, sorted(self.digests))), files)

    def _write_waiting(self) -> None:
        """Write rows in the order of their logs' digests, and so of the names of drives."""
        digests = sorted(self._waiting)
        if digests:
            rows = [self._waiting[digest] for digest in digests]
            self._written.append(self._begin(f"measured-{digest_of(digests)[:24]}", rows))
            self._waiting = {}

    def _begin(self, name: str, rows: list[pa.Table]) -> Future[list[AddAction]]:
        """Write rows while the caller goes on; at most `WRITERS` files are under way."""
        begun = [*self._written, *self._of_this_log]
        if len(begun) >= WRITERS:
            begun[-WRITERS].result()
        return self._threads.submit(self._write, name, rows)

    def _write(self, name: str, rows: list[pa.Table]) -> list[AddAction]:
        by_day = _by_day(pa.concat_tables(rows).unify_dictionaries())
        encoded = {day: self._table.encode(part) for day, part in by_day.items()}
        del by_day  # a disk may take its time
        return [self._table.put(name, content, day) for day, content in encoded.items()]


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
    columns, signal_catalog = {}, mapping.signal_catalog
    for column in signal_catalog.log_schema:
        if column.name == "tick":
            ticks = [as_arrow(drive.ticks) for drive in drives]
            columns[column.name] = pa.chunked_array(ticks, column.type)
        elif column.name in mapping.signal_names:
            columns[column.name] = pa.chunked_array([drive.counts[column.name] for drive in drives])
        elif column.name in signal_catalog.extras:
            continue
        elif column.name in signal_catalog.signals:
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
    return pl.Series(values, strict=False).gather(at).to_arrow().cast(kind)


# What was written is committed: refused rows, then drives.


def commit_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
    build_removal: BuildRemoval | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit what was written of a batch; return it, and the transactions added to the logs.

    Where something was forgotten, or committed by another process, since it was written, `write`
    writes it again. What gives way to the new files is taken out in the same commits.
    """
    tables = tables_of(warehouse)

    def is_outdated(name: TableName, snapshot: Snapshot) -> bool:
        # Asked after the snapshot: who forgets a car from now on makes this commit a conflict.
        if ErasureLog(warehouse.root).begun() != written.forgotten:
            return True
        landed = snapshot.landed_among(len(written.new[name].transactions))
        if any(landed(transaction.name) for transaction in written.new[name].transactions):
            return True
        new = [one for one in written.files if one.fingerprints] if name == "logs" else []
        known = Fingerprints(snapshot.transactions if new else {})
        return any(known.find(one.fingerprints) - one.same for one in new)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        while is_outdated(name, snapshot):
            for other, table in tables.items():
                table.discard(written.new[other].files)  # but what has landed
            written = write()
            snapshot = tables[name].snapshot()
        new = written.new[name]
        gone = Change()
        if written.replaced and build_removal and written.new["logs"].files:
            gone = build_removal(name, snapshot, written.replaced)
        transactions = {
            transaction.name: transaction for transaction in (*gone.transactions, *new.transactions)
        }
        for one in written.files if name == "logs" else ():
            transactions |= {
                mark: AppTransaction(mark, number) for mark, number in one.fingerprints.items()
            }
        if new.files or gone.remove:
            add = [*new.files, *gone.add]
            try:
                snapshot.commit(Change(add, gone.remove, tuple(transactions.values()), note))
            except ConflictError:
                tables[name].discard(gone.add)
                raise
        return (
            frozenset(transaction.name for transaction in new.transactions)
            if new.files
            else frozenset()
        )

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new
