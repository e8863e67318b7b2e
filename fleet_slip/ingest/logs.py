"""Stores measured logs in the warehouse. The same file with the same mapping is stored once.

`ingest_files` processes batches of logs: `write_batch` reads each log and writes data files,
`commit_batch` commits them.
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

from fleet_slip.base import Record, pluralize
from fleet_slip.catalog.counts import as_arrow
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import ConfigError, ConflictError, InputError, RepeatedError
from fleet_slip.ingest.log_files import size_of
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import IngestCounts, MeasuredStream, open_measured
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
    tables_of,
)
from fleet_slip.ingest.ticks import MeasuredDrive, drive_id
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.drive_signals import Signals, to_regular_grid
from fleet_slip.quality.plausibility import check_plausibility
from fleet_slip.rendering import Answer, Part, TextTable
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, Table, retry_conflicts
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.warehouse import Warehouse

BATCH_BYTES = 2**24
"""Files are read, written and committed together up to this size."""
BATCH_FILES = 500
FAILURES_SHOWN = 5


class IngestTask(NamedTuple):
    """A file to ingest, and the digest of the content that its path had when last ingested."""

    file: Path
    earlier: str | None = None


Batch: TypeAlias = tuple[IngestTask, ...]
BuildRemoval: TypeAlias = Callable[[TableName, Snapshot, Collection[SourceRef]], Change]
"""Build the commit that deletes the drives, or rejected rows, of these sources from a table."""


@dataclass
class FileReport(Record):
    """The counts of a file and what looks implausible in it."""

    file: str
    counts: IngestCounts
    suspicions: tuple[Fault, ...] = ()
    """Faults of the file; and of the longest drive, in the report of one file of a batch."""

    @property
    def alarms(self) -> tuple[Fault, ...]:
        """The faults that harm a model."""
        return tuple(fault for fault in self.suspicions if fault.does_harm)


@dataclass
class IngestReport(FileReport):
    """The result of ingesting one file."""

    DOCUMENT = "file new *counts rows_quarantined drives_forgotten drives_replaced suspicions"

    new: bool = True
    drives_forgotten: int = 0
    """Drives that were skipped because they, or their cars, were erased."""
    drives_replaced: int = 0
    """Drives that this file replaces: the same recording, or the same path with other content."""

    @property
    def rows_quarantined(self) -> int:
        """Number of rejected rows."""
        return sum(self.counts.quarantined.values())


@dataclass(frozen=True)
class SignalRange:
    """The values of a signal in a file, in the catalog's unit."""

    signal: str
    unit: str
    low: float
    high: float
    missing: float
    """Fraction of the ticks without a value."""


@dataclass
class Preview(FileReport, Answer):
    """The result that ingesting a file would have."""

    DOCUMENT = "file *counts ranges suspicions"

    ranges: tuple[SignalRange, ...] = ()

    def parts(self) -> Iterator[Part]:
        """Return the counts of rows, a table of the signals, and the faults."""
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
            text_columns=2,
        )
        yield from (f"looks wrong: {fault}" for fault in self.suspicions)


@dataclass
class WrittenFile:
    """A file of a batch after writing: its report and its fingerprints.

    Attributes
    ----------
    same
        Sources with its fingerprints, whether their rows still exist or not.
    replaced
        The sources that it replaces.
    """

    log: Path
    digest: str
    report: IngestReport
    fingerprints: dict[str, int] = field(default_factory=dict)
    same: frozenset[SourceRef] = frozenset()
    replaced: frozenset[SourceRef] = frozenset()


class NewFiles(NamedTuple):
    """Uncommitted data files of one table, and their transactions."""

    transactions: tuple[AppTransaction, ...]
    files: tuple[AddAction, ...]


@dataclass(frozen=True)
class WrittenBatch:
    """A batch after writing; `forgotten` are the entries of the erasure log that it respects."""

    files: tuple[WrittenFile, ...]
    failures: tuple[InputError, ...]
    forgotten: frozenset[int]
    new: dict[TableName, NewFiles]

    @property
    def replaced(self) -> frozenset[SourceRef]:
        """The sources that the batch replaces."""
        return frozenset[SourceRef]().union(*(file.replaced for file in self.files))


def ingest_files(
    warehouse: Warehouse,
    files: Iterable[Path],
    mapping: Mapping,
    executor: Executor | None = None,
    cache: IngestCache | None = None,
    replace: Replace = "no",
    build_removal: BuildRemoval | None = None,
) -> Iterator[IngestReport]:
    """Ingest files and yield the report of each after its commit.

    Small files are committed together. The workers of an executor read batches in any order; large
    files, each of which uses all cores, are not given to threads. `cache` skips files that were
    ingested before. A stored recording is refused, or replaced by `replace`: then `build_removal`
    deletes the old rows in the same commit.

    Raises at the end `InputError` with all files that cannot be used, or `RepeatedError` if all of
    these are stored already; `ClusterError` for files at which workers died; and `ConfigError` for
    a mapping of other signals.
    """
    if mapping.signal_catalog != warehouse.catalog.signals:  # counts would have another scale
        raise ConfigError(
            f"the mapping {mapping.name!r} was loaded with other signals than those of "
            f"{warehouse.root}. Load it with the configs of this data root."
        )
    write = partial(write_batch, warehouse, mapping, replace=replace)
    warehouse.logs.require_writable(mapping.signal_names)
    failures: list[InputError] = []
    stored = 0
    tasks = (IngestTask(file, cache.digest_of(file) if cache else None) for file in files)
    for batch, written in _written(executor, write, _batches(tasks)):
        # Not the file's name: it may contain a car's name, and the Delta log outlives erasures.
        digest = digest_of([file.digest for file in written.files])
        note = {"job": "ingest", "mapping": mapping.name, "digest": digest}
        committed, new = commit_batch(
            warehouse, written, partial(write, batch), note, build_removal
        )
        failures += committed.failures
        stored += len(committed.files)
        for file in committed.files:
            transaction = file_transaction(file.digest).name
            yield _finished(warehouse, file, is_new=transaction in new)
            new -= {transaction}  # a second file with the same content is not new
            if cache is not None:
                cache.remember(file.log, file.digest)
    if failures:
        raise _joined(failures, stored)


def _written(
    executor: Executor | None, write: Callable[[Batch], WrittenBatch], batches: Iterable[Batch]
) -> Iterator[tuple[Batch, WrittenBatch]]:
    """Yield each batch with its result, large files last and not by threads."""
    alone: list[Batch] = []
    if isinstance(executor, ThreadPoolExecutor):
        together: list[Batch] = []
        for batch in batches:
            (alone if size_of(batch[0].file) >= BATCH_BYTES else together).append(batch)
        batches = together
    yield from run_tasks(executor, write, batches, lambda batch: str(batch[0].file))
    yield from ((batch, write(batch)) for batch in alone)


def _batches(files: Iterable[IngestTask]) -> Iterator[Batch]:
    """Group files, in order, into batches of at most `BATCH_BYTES` or one file."""
    batch: list[IngestTask] = []
    size = 0
    for task in files:
        size_bytes = size_of(task.file)
        if batch and (size + size_bytes > BATCH_BYTES or len(batch) >= BATCH_FILES):
            yield tuple(batch)
            batch, size = [], 0
        batch.append(task)
        size += size_bytes
    if batch:
        yield tuple(batch)


def _finished(warehouse: Warehouse, written: WrittenFile, *, is_new: bool) -> IngestReport:
    """Return the report of a file; `is_new` if this process committed it."""
    report = written.report
    report.new = is_new
    if not is_new:
        report.suspicions, report.drives_replaced = (), 0
        if not report.drives_forgotten and is_fully_erased(warehouse, written.digest):
            report.drives_forgotten = report.counts.drives
            report.counts = dataclasses.replace(report.counts, drives=0, ticks=0)
    return report


def _joined(failures: list[InputError], stored: int) -> InputError:
    """Return one error for all failures; `stored` is the number of the other files."""
    if len(failures) == 1:
        return failures[0]
    first = " ".join(map(str, failures[:FAILURES_SHOWN]))
    more = len(failures) - FAILURES_SHOWN
    others = "; all others are stored" if stored else ""
    kind = (
        RepeatedError
        if all(isinstance(failure, RepeatedError) for failure in failures)
        else InputError
    )
    return kind(
        f"{pluralize(len(failures), 'file')} cannot be used{others}. {first}"
        + (f" And {more:,} more." if more > 0 else "")
    )


# A batch of files becomes data files.

FILE_ROWS = 2**18
"""Rows at which a data file is written. Its last drive may exceed them."""


def write_batch(
    warehouse: Warehouse, mapping: Mapping, files: Batch, replace: Replace = "no"
) -> WrittenBatch:
    """Read files and write their rows, together in one data file a day. Commits nothing.

    A file that cannot be used becomes a failure; the others are written.
    """
    failures: list[InputError] = []
    written: list[WrittenFile] = []
    longest: list[tuple[FileReport, MeasuredDrive | None]] = []
    with ThreadPoolExecutor(WRITERS) as writers:
        batch = _Writer(warehouse, mapping, files, writers, replace)
        for task in files:
            try:
                with open_measured(task.file, mapping) as stream:
                    report_of_file = batch.write(stream, task)
            except BaseException as error:
                for data in batch.data.values():
                    data.discard_log()
                if not isinstance(error, InputError):
                    raise
                failures.append(error)
            else:
                for data in batch.data.values():
                    data.end_log()
                written.append(report_of_file)
                if report_of_file.report.new:
                    longest.append((report_of_file.report, stream.longest))
        _check_longest(mapping, longest)
        new = {name: data.finish() for name, data in batch.data.items()}
    return WrittenBatch(tuple(written), tuple(failures), batch.forgotten, new)


def _check_longest(
    mapping: Mapping, results: Iterable[tuple[FileReport, MeasuredDrive | None]]
) -> None:
    """Check the longest drive of each file; report a fault with the longest drive that has it.

    `CHECKED_TICKS` bound the time of a batch: a check takes as long as loading a small file.
    """
    drives = [(report, drive) for report, drive in results if drive is not None]
    drives.sort(key=lambda pair: pair[1].ticks.size, reverse=True)
    from_velocities = mapping.label is not None and mapping.label.from_velocities
    faults: dict[tuple[str, tuple[str, ...]], list[tuple[FileReport, Fault]]] = {}
    for report, drive in drives:
        ticks = max(CHECKED_TICKS // len(drives), MIN_CHECKED_TICKS)
        signals = signals_of(mapping.signal_catalog, drive, ticks)
        for fault in check_plausibility(
            mapping.signal_catalog, signals, from_velocities=from_velocities
        ):
            faults.setdefault((fault.kind, fault.signals), []).append((report, fault))
    for (report, fault), *repeats in faults.values():
        also = f", as in {pluralize(len(repeats), 'other file')}" if repeats else ""
        report.suspicions += (dataclasses.replace(fault, figure=fault.figure + also),)


class _Writer:
    """Writes the files of a batch."""

    def __init__(
        self,
        warehouse: Warehouse,
        mapping: Mapping,
        files: Batch,
        writers: ThreadPoolExecutor,
        replace: Replace,
    ) -> None:
        self.warehouse, self.mapping = warehouse, mapping
        self.erasure_log = ErasureLog(warehouse.root)
        self.forgotten, self._number = self.erasure_log.begun(), len(files)
        logs = self._look()
        self.data = {name: DataFiles(t, writers) for name, t in tables_of(warehouse).items()}
        self._same = DuplicateDetector(warehouse, logs, mapping.name, replace)

    def _look(self) -> Snapshot:
        """Read the current state of the tables; return a snapshot of the logs."""
        snapshots = {name: table.snapshot() for name, table in tables_of(self.warehouse).items()}
        self._landed = {
            name: written.transaction_lookup(self._number) for name, written in snapshots.items()
        }
        return snapshots["logs"]

    def _lacks(self, name: TableName, digest: str) -> bool:
        """Return True if a file's rows are neither in a table nor in this batch."""
        return digest not in self.data[name].digests and not self._landed[name](FILES + digest)

    def write(self, stream: MeasuredStream, task: IngestTask) -> WrittenFile:
        """Read a file and write its rows; the last rows wait for those of other files.

        Raises `InputError`, and `RepeatedError` for a stored recording.
        """
        digest, first_drive = stream.digest, drive_id(stream.prefix, 0)
        if not self._lacks("logs", digest) and readmit_file(self.warehouse, digest, first_drive):
            self._look()
        is_new = self._lacks("logs", digest)
        for name, data in self.data.items():
            data.begin_log(digest, is_new=is_new and self._lacks(name, digest))
        fingerprints = {f"{PREFIX}{stream.content[:16]}": SourceRef.of_file(digest).number}
        left_out, ticks = set[str](), 0
        for drives in _groups(stream.drives()):
            accepted = drop_erased_drives(
                sorted(drives, key=lambda drive: drive.drive_id), self.erasure_log
            )
            left_out |= {drive.drive_id for drive in drives} - {
                drive.drive_id for drive in accepted
            }
            ticks += _rows_of(accepted)
            if is_new and accepted:
                full = _rows_of(drives) >= FILE_ROWS
                self.data["logs"].add(log_table(accepted, self.mapping), full=full)
                fingerprints |= fingerprints_of(accepted)
        for table, following in pairwise(chain(stream.quarantine(), [None])):
            allowed = drop_erased_rejects(table, self.erasure_log, left_out)
            self.data["quarantine"].add(allowed, full=following is not None)
        report = IngestReport(str(task.file), stream.counts, new=is_new)
        written = WrittenFile(task.file, digest, report)
        if is_new:
            report.drives_forgotten, report.suspicions = len(left_out), stream.suspicions()
            drives_left = stream.counts.drives - len(left_out)
            report.counts = dataclasses.replace(stream.counts, drives=drives_left, ticks=ticks)
            written.fingerprints = fingerprints if ticks else {}
            is_there = task.earlier and self._landed["logs"](FILES + task.earlier)
            earlier = task.earlier if is_there else None
            duplicates = self._same.find(
                task.file, digest, written.fingerprints, stream.name, earlier
            )
            written.same, written.replaced, report.drives_replaced = duplicates
        return written


def _groups(drives: Iterable[MeasuredDrive]) -> Iterator[list[MeasuredDrive]]:
    """Yield groups of drives with the rows of a data file; the last group may have fewer."""
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


# Dry run: files are read as above, and nothing is written.


def preview_logs(logs: Iterable[Path], mapping: Mapping) -> list[Preview]:
    """Read logs and check them as `ingest_files` does, and store nothing.

    Raises `InputError`.
    """
    previews: list[Preview] = []
    for batch in _batches(map(IngestTask, logs)):
        results = [preview_log(task.file, mapping) for task in batch]
        _check_longest(mapping, results)
        previews += [preview for preview, _ in results]
    return previews


def preview_log(log: Path, mapping: Mapping) -> tuple[Preview, MeasuredDrive | None]:
    """Return the preview of a log and its longest drive. Raises `InputError`."""
    ends: dict[str, list[int]] = {name: [] for name in mapping.signal_names}
    values: Counter[str] = Counter()
    with open_measured(log, mapping) as stream:
        for drive in stream.drives():
            for name, counts in drive.counts.items():
                values[name] += len(counts) - counts.null_count
                extremes = pc.min_max(counts).as_py()
                ends[name] += [] if extremes["min"] is None else [extremes["min"], extremes["max"]]
        suspicions = stream.suspicions()  # may read the file again
    ranges = []
    for name, bounds in ends.items():
        signal = mapping.signal_catalog[name]
        scale = float(signal.scale)
        low, high = (scale * min(bounds), scale * max(bounds)) if bounds else (np.nan, np.nan)
        missing = 1 - values[name] / max(stream.counts.ticks, 1)
        ranges.append(SignalRange(name, signal.unit, low, high, missing))
    return Preview(str(log), stream.counts, suspicions, tuple(ranges)), stream.longest


CHECKED_TICKS, MIN_CHECKED_TICKS = 200_000, 6_000
"""Ticks that are checked in a batch of files, half an hour, and in each file, a minute."""


def signals_of(signals: SignalCatalog, drive: MeasuredDrive, ticks: int) -> Signals:
    """Return the signals of the first ticks of a drive, as `check_plausibility` reads them."""
    selected = drive.ticks - drive.ticks[0] < ticks
    counts = {  # by Polars: Arrow's own would load pandas
        name: pl.Series(values).cast(pl.Float64).fill_null(float("nan")).to_numpy()[selected]
        for name, values in drive.counts.items()
    }
    return to_regular_grid(signals, drive.ticks[selected], counts)


# Writing data files of bounded size.

WRITERS = 2
"""Data files written at the same time; encoding them takes most of the time of an ingest."""


class DataFiles:
    """The data files of a batch in one table. Each log is begun, then ended or discarded."""

    def __init__(self, table: Table, threads: ThreadPoolExecutor) -> None:
        """Take the table, and threads to write with."""
        self._table, self._threads = table, threads
        self._written: list[Future[list[AddAction]]] = []
        self._of_this_log: list[Future[list[AddAction]]] = []
        self._waiting: dict[str, pa.Table] = {}
        self.digests: list[str] = []

    def begin_log(self, digest: str, *, is_new: bool) -> None:
        """Begin a log. Its rows are ignored unless it is new."""
        self._digest, self._is_new = digest, is_new
        self._remaining: pa.Table | None = None

    def add(self, rows: pa.Table, *, full: bool) -> None:
        """Write rows to a data file of their own if `full`, else keep them for `end_log`."""
        if self._is_new and rows.num_rows:
            if full:
                name = f"measured-{self._digest[:24]}-{len(self._of_this_log) + 1}"
                self._of_this_log.append(self._begin(name, [rows]))
            else:
                self._remaining = rows

    def end_log(self) -> None:
        """End the log: its remaining rows wait for those of other logs."""
        if self._of_this_log or self._remaining is not None:
            self.digests.append(self._digest)
        self._written += self._of_this_log
        self._of_this_log = []
        if self._remaining is not None:
            self._waiting[self._digest] = self._remaining
        if sum(rows.num_rows for rows in self._waiting.values()) >= FILE_ROWS:
            self._write_waiting()

    def discard_log(self) -> None:
        """Delete the files written of the current log."""
        written = [writing for writing in self._of_this_log if writing.exception() is None]
        self._table.discard(file for writing in written for file in writing.result())
        self._of_this_log = []

    def finish(self) -> NewFiles:
        """Wait for all data files; return them and their transactions."""
        self._write_waiting()
        files = tuple(file for writing in self._written for file in writing.result())
        return NewFiles(tuple(map(file_transaction, sorted(self.digests))), files)

    def _write_waiting(self) -> None:
        """Write waiting rows in the order of their logs' digests, which is that of drive names."""
        digests = sorted(self._waiting)
        if digests:
            rows = [self._waiting[digest] for digest in digests]
            self._written.append(self._begin(f"measured-{digest_of(digests)[:24]}", rows))
            self._waiting = {}

    def _begin(self, name: str, rows: list[pa.Table]) -> Future[list[AddAction]]:
        """Start writing rows, after the oldest of `WRITERS` files under way has ended."""
        begun = [*self._written, *self._of_this_log]
        if len(begun) >= WRITERS:
            begun[-WRITERS].result()
        return self._threads.submit(self._write, name, rows)

    def _write(self, name: str, rows: list[pa.Table]) -> list[AddAction]:
        by_day = _by_day(pa.concat_tables(rows).unify_dictionaries())
        encoded = {day: self._table.encode(of_day) for day, of_day in by_day.items()}
        del by_day  # frees memory during slow writes
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def _by_day(rows: pa.Table) -> dict[Any, pa.Table]:
    """Return rows by day; rejected rows, which have no day, under None."""
    if "day" not in rows.column_names:
        return {None: rows}
    days = rows["day"].unique().to_pylist()
    if len(days) == 1:
        return {days[0]: rows}
    return {day: rows.filter(pc.equal(rows["day"], pa.scalar(day, pa.date32()))) for day in days}


def log_table(drives: Sequence[MeasuredDrive], mapping: Mapping) -> pa.Table:
    """Return the rows of `logs` for these drives; strings are dictionary-encoded."""
    sizes = [drive.ticks.size for drive in drives]
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
            columns[column.name] = pa.nulls(sum(sizes), column.type)
        else:
            values = [drive.metadata.get(column.name) for drive in drives]
            columns[column.name] = _repeat(values, sizes, column.type)
    return pa.table(columns)


def _repeat(values: Sequence[Any], sizes: Sequence[int], kind: pa.DataType) -> pa.Array:
    """Return a column with each value so many times; strings are dictionary-encoded.

    Not by `pa.array`, which imports pandas if installed.
    """
    if pa.types.is_string(kind):
        texts = list(dict.fromkeys(text for text in values if text is not None))
        codes = [None if text is None else texts.index(text) for text in values]
        named = pl.Series(texts, dtype=pl.String).to_arrow().cast(kind)
        return pa.DictionaryArray.from_arrays(_repeat(codes, sizes, pa.int32()), named, safe=False)
    column = pl.Series(values, strict=False)
    if column.null_count() == len(column):
        return pa.nulls(sum(sizes), kind)
    numbers = column.to_physical().fill_null(0).to_numpy()
    absent = column.is_null().to_numpy() if column.null_count() else None
    repeated = as_arrow(
        np.repeat(numbers, sizes), None if absent is None else np.repeat(absent, sizes)
    )
    return repeated.view(column.to_arrow().type).cast(kind)


# Commits: rejected rows first, then drives.


def commit_batch(
    warehouse: Warehouse,
    written: WrittenBatch,
    write: Callable[[], WrittenBatch],
    note: dict[str, str],
    build_removal: BuildRemoval | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit a batch; return it and the transactions added to the logs.

    If an erasure or another process's commit makes the batch outdated, `write` writes it again. The
    sources that it replaces are deleted in the same commits.
    """
    tables = tables_of(warehouse)

    def is_outdated(name: TableName, snapshot: Snapshot) -> bool:
        # After the snapshot: an erasure that begins from now on makes this commit a conflict.
        if ErasureLog(warehouse.root).begun() != written.forgotten:
            return True
        landed = snapshot.transaction_lookup(len(written.new[name].transactions))
        if any(landed(transaction.name) for transaction in written.new[name].transactions):
            return True
        new = [file for file in written.files if file.fingerprints] if name == "logs" else []
        fingerprints = Fingerprints(snapshot.transactions if new else {})
        return any(fingerprints.find(file.fingerprints) - file.same for file in new)

    def commit(name: TableName) -> frozenset[str]:
        nonlocal written
        snapshot = tables[name].snapshot()
        while is_outdated(name, snapshot):
            for other, table in tables.items():
                table.discard(written.new[other].files)  # except committed ones
            written = write()
            snapshot = tables[name].snapshot()
        new = written.new[name]
        removal = Change()
        if written.replaced and build_removal and written.new["logs"].files:
            removal = build_removal(name, snapshot, written.replaced)
        transactions = {t.name: t for t in (*removal.transactions, *new.transactions)}
        for file in written.files if name == "logs" else ():
            transactions |= {
                fingerprint: AppTransaction(fingerprint, number)
                for fingerprint, number in file.fingerprints.items()
            }
        if new.files or removal.remove:
            add = [*new.files, *removal.add]
            try:
                snapshot.commit(Change(add, removal.remove, tuple(transactions.values()), note))
            except ConflictError:
                tables[name].discard(removal.add)
                raise
        return frozenset(t.name for t in new.transactions) if new.files else frozenset()

    retry_conflicts(lambda: commit("quarantine"))
    new = retry_conflicts(lambda: commit("logs"))
    return written, new
