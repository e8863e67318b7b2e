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
from typing import NamedTuple, Self, TypeAlias

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from deltalake.transaction import AddAction

from fleet_slip.base import Record, pluralize, quote_name
from fleet_slip.catalog.counts import as_arrow, as_floats
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import ConfigError, ConflictError, InputError, RepeatedError
from fleet_slip.ingest.checked_columns import IngestCounts
from fleet_slip.ingest.log_files import size_of
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import MeasuredLog, open_measured
from fleet_slip.ingest.recordings import (
    FILE_PREFIX,
    Fingerprints,
    IngestCache,
    Replace,
    SourceRef,
    TableName,
    combine_digests,
    drop_erased_drives,
    drop_erased_rejects,
    file_transaction,
    find_duplicates,
    fingerprints_of,
    readmit_file,
    stored_drives,
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
TEXTS_SHOWN = 5


class IngestTask(NamedTuple):
    """A file to ingest, and the digest of the content that its path had when last ingested."""

    file: Path
    previous_digest: str | None = None


Batch: TypeAlias = tuple[IngestTask, ...]
Failure: TypeAlias = tuple[Path, InputError]
BuildRemoval: TypeAlias = Callable[[TableName, Snapshot, Collection[SourceRef]], Change]
"""Build the commit that deletes the drives, or rejected rows, of these sources from a table."""


@dataclass(frozen=True)
class IngestReport(Record):
    """The counts of a file and what looks implausible in it."""

    DOCUMENT = "file new *counts rows_quarantined drives_forgotten drives_replaced suspicions"

    file: str
    counts: IngestCounts
    suspicions: tuple[Fault, ...] = ()
    """Faults of the file, and of its longest drive unless another file of the batch has them."""
    new: bool = True
    drives_forgotten: int = 0
    """Drives that were skipped because they, or their cars, were erased."""
    drives_replaced: int = 0
    """Drives that this file replaces: the same recording, or the same path with other content."""

    def with_faults(self, faults: Iterable[Fault]) -> Self:
        """Return the report with more faults."""
        return dataclasses.replace(self, suspicions=(*self.suspicions, *faults))

    @property
    def alarms(self) -> tuple[Fault, ...]:
        """The faults that harm a model."""
        return tuple(fault for fault in self.suspicions if fault.does_harm)

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


@dataclass(frozen=True)
class Preview(IngestReport, Answer):
    """The result that ingesting a file would have."""

    DOCUMENT = "file *counts ranges suspicions"

    ranges: tuple[SignalRange, ...] = ()

    def parts(self) -> Iterator[Part]:
        """Return the counts of rows, a table of the signals, and the faults."""
        counts = self.counts
        rejected = ", ".join(f"{n:,} {reason}" for reason, n in counts.quarantined.items())
        yield TextTable(
            f"{self.file}: {pluralize(counts.rows_read, 'row')}; left out by conditions "
            f"{counts.rows_left_out:,}; rejected {self.rows_quarantined:,}"
            f"{f' ({rejected})' if rejected else ''}; {pluralize(counts.drives, 'drive')} of "
            f"{pluralize(counts.ticks, 'tick')}",
            "signal|unit|least|most|missing",
            self.ranges,
            "{signal}|{unit}|{low:.4g}|{high:.4g}|{missing:.1%}",
            text_columns=2,
        )
        yield from (f"looks wrong: {fault}" for fault in self.suspicions)


@dataclass(frozen=True)
class WrittenFile:
    """A file of a batch after writing.

    `fingerprints` are those of the file and its drives, with the number of their `SourceRef`;
    `stored_sources` have one of them, and `replaced` are the sources that the file replaces.
    """

    log: Path
    digest: str
    report: IngestReport
    longest: MeasuredDrive | None = None
    fingerprints: dict[str, int] = field(default_factory=dict)
    stored_sources: frozenset[SourceRef] = frozenset()
    replaced: frozenset[SourceRef] = frozenset()


@dataclass(frozen=True)
class WrittenBatch:
    """A batch after writing.

    `erasures` are the entries of the erasure log that it respects. `added` are its uncommitted data
    files, and `digests` the logs with rows in these, by table.
    """

    files: tuple[WrittenFile, ...]
    failures: tuple[Failure, ...]
    erasures: frozenset[int]
    added: dict[TableName, list[AddAction]]
    digests: dict[TableName, list[str]]


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
    failures: list[Failure] = []
    stored = 0
    tasks = (IngestTask(file, cache.previous_digest(file) if cache else None) for file in files)
    for batch, written in _write_batches(executor, write, _batches(tasks)):
        # Not the file's name: it may contain a car's name, and the Delta log outlives erasures.
        digest = combine_digests([file.digest for file in written.files])
        note = {"job": "ingest", "mapping": mapping.name, "digest": digest}
        committed, new = commit_batch(
            warehouse, written, partial(write, batch), note, build_removal
        )
        failures += committed.failures
        stored += len(committed.files)
        for file in committed.files:
            yield file.report if file.digest in new else _report_stored(warehouse, file)
            new -= {file.digest}  # a second file with the same content is not new
            if cache is not None:
                cache.remember(file.log, file.digest)
    if failures:
        raise _join_failures(failures, stored)


def _write_batches(
    executor: Executor | None, write: Callable[[Batch], WrittenBatch], batches: Iterable[Batch]
) -> Iterator[tuple[Batch, WrittenBatch]]:
    """Yield each batch with its result, large files last and not by threads."""
    large: list[Batch] = []
    if isinstance(executor, ThreadPoolExecutor):
        small: list[Batch] = []
        for batch in batches:  # a large file is a batch of its own
            (large if size_of(batch[0].file) >= BATCH_BYTES else small).append(batch)
        batches = small
    yield from run_tasks(executor, write, batches, lambda batch: str(batch[0].file))
    yield from ((batch, write(batch)) for batch in large)


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


def _report_stored(warehouse: Warehouse, written: WrittenFile) -> IngestReport:
    """Return the report of a file whose content was stored before, or erased."""
    report = dataclasses.replace(written.report, new=False, suspicions=(), drives_replaced=0)
    if report.drives_forgotten or not ErasureLog(warehouse.root).entries():
        return report
    if stored_drives(warehouse, {SourceRef.of_file(written.digest)}):
        return report
    counts = dataclasses.replace(report.counts, drives=0, ticks=0)
    return dataclasses.replace(report, counts=counts, drives_forgotten=report.counts.drives)


def _join_failures(failures: Sequence[Failure], stored: int) -> InputError:
    """Return one error that names each reason once; `stored` is the number of the other files."""
    if len(failures) == 1:
        return failures[0][1]
    reasons: dict[str, list[str]] = {}
    for file, failure in failures:
        name = quote_name(file)
        reasons.setdefault(str(failure).removeprefix(f"{name}: "), []).append(name)
    texts = [f"{_shorten(files)}: {reason}" for reason, files in reasons.items()]
    are_repeated = all(isinstance(failure, RepeatedError) for _, failure in failures)
    return (RepeatedError if are_repeated else InputError)(
        f"{pluralize(len(failures), 'file')} cannot be used"
        f"{'; all others are stored' if stored else ''}. {_shorten(texts, ' ')}"
    )


def _shorten(texts: Sequence[str], separator: str = ", ") -> str:
    more = f" and {len(texts) - TEXTS_SHOWN:,} more" if len(texts) > TEXTS_SHOWN else ""
    return separator.join(texts[:TEXTS_SHOWN]) + more


# A batch of files becomes data files.

FILE_ROWS = 2**18
"""Rows at which a data file is written. Its last drive may exceed them."""


def write_batch(
    warehouse: Warehouse, mapping: Mapping, files: Batch, replace: Replace = "no"
) -> WrittenBatch:
    """Read files and write their rows, together in one data file a day. Commits nothing.

    A file that cannot be used becomes a failure; the others are written.
    """
    failures: list[Failure] = []
    written: list[WrittenFile] = []
    with ThreadPoolExecutor(WRITERS) as threads:
        writer = _BatchWriter(warehouse, mapping, threads, replace)
        for task in files:
            try:
                written.append(writer.write(task))
            except InputError as error:
                failures.append((task.file, error))
        added = {name: data.finish() for name, data in writer.data.items()}
    faults = check_longest(mapping, [file.longest for file in written])
    checked = tuple(
        dataclasses.replace(file, report=file.report.with_faults(of_file), longest=None)
        for file, of_file in zip(written, faults, strict=True)
    )
    digests = {name: sorted(data.digests) for name, data in writer.data.items()}
    return WrittenBatch(checked, tuple(failures), writer.erasures, added, digests)


class _BatchWriter:
    """Writes the files of a batch to data files, without a commit."""

    def __init__(
        self, warehouse: Warehouse, mapping: Mapping, threads: ThreadPoolExecutor, replace: Replace
    ) -> None:
        self._warehouse, self._mapping, self._replace = warehouse, mapping, replace
        self._erasure_log = ErasureLog(warehouse.root)
        self.erasures = self._erasure_log.begun()
        self.data = {name: DataFiles(t, threads) for name, t in tables_of(warehouse).items()}
        self._file_of_fingerprint: dict[str, Path] = {}
        """Files of the batch by their fingerprints."""
        self._refresh()

    def _refresh(self) -> None:
        tables = tables_of(self._warehouse).items()
        self._snapshots = {name: table.snapshot() for name, table in tables}
        self._stored_fingerprints = Fingerprints(self._snapshots["logs"].transactions)

    def _lacks(self, name: TableName, digest: str) -> bool:
        """Return True if a file's rows are neither in a table nor in this batch."""
        is_stored = self._snapshots[name].has_committed(FILE_PREFIX + digest)
        return digest not in self.data[name].digests and not is_stored

    def write(self, task: IngestTask) -> WrittenFile:
        """Read a file and write its rows; the last rows wait for those of other files.

        Raises `InputError`, and `RepeatedError` for a stored recording.
        """
        with open_measured(task.file, self._mapping) as log:
            if not self._lacks("logs", log.digest):
                is_readmitted = readmit_file(self._warehouse, log.digest, drive_id(log.prefix, 0))
                if is_readmitted:
                    self._refresh()
            if not self._lacks("logs", log.digest):
                for _ in log.drives():  # counts the rows
                    pass
                return WrittenFile(
                    task.file, log.digest, IngestReport(str(task.file), log.counts, new=False)
                )
            with_rejects = self._lacks("quarantine", log.digest)
            try:
                return self._write_new(task, log, with_rejects=with_rejects)
            except BaseException:
                self.data["logs"].discard(log.digest)
                if with_rejects:
                    self.data["quarantine"].discard(log.digest)
                raise

    def _write_new(self, task: IngestTask, log: MeasuredLog, *, with_rejects: bool) -> WrittenFile:
        """Write the drives and the rejected rows of a log; find the drives that it replaces."""
        ticks, erased, fingerprints = self._write_drives(log)
        # Each table of rejected rows but the last fills a data file.
        for table, following in pairwise(chain(log.quarantine(), [None])):
            if with_rejects and table is not None:
                allowed = drop_erased_rejects(table, self._erasure_log, erased)
                self.data["quarantine"].add(log.digest, allowed, full=following is not None)
        if repeated := self._file_of_fingerprint.keys() & fingerprints.keys():
            # A file with other bytes: identical files are stored once anyway.
            raise RepeatedError(
                f"{quote_name(task.file)}: same recording as "
                f"{quote_name(self._file_of_fingerprint[min(repeated)])}. Leave one of them out."
            )
        earlier = task.previous_digest
        if earlier and not self._snapshots["logs"].has_committed(FILE_PREFIX + earlier):
            earlier = None
        duplicates = find_duplicates(
            self._warehouse,
            self._stored_fingerprints,
            self._replace,
            task.file,
            log,
            fingerprints,
            earlier,
        )
        report = IngestReport(
            str(task.file),
            dataclasses.replace(log.counts, drives=log.counts.drives - len(erased), ticks=ticks),
            suspicions=log.suspicions(),
            drives_forgotten=len(erased),
            drives_replaced=len(duplicates.replaced_drives),
        )
        self._file_of_fingerprint |= dict.fromkeys(fingerprints, task.file)
        for data in self.data.values():
            data.end_log()
        return WrittenFile(
            task.file,
            log.digest,
            report,
            log.longest,
            fingerprints,
            duplicates.sources,
            duplicates.replaced,
        )

    def _write_drives(self, log: MeasuredLog) -> tuple[int, set[str], dict[str, int]]:
        """Write the drives of a log; return the ticks, the erased drives, and the fingerprints.

        A log of erased drives only has no fingerprints.
        """
        ticks, erased = 0, set[str]()
        fingerprints = {log.fingerprint: SourceRef.of_file(log.digest).number}
        for drives in _group_drives(log.drives()):
            drives.sort(key=lambda drive: drive.drive_id)
            accepted = drop_erased_drives(drives, self._erasure_log)
            erased |= {drive.drive_id for drive in drives} - {drive.drive_id for drive in accepted}
            ticks += _count_ticks(accepted)
            if accepted:
                rows = log_table(accepted, self._mapping)
                self.data["logs"].add(log.digest, rows, full=_count_ticks(drives) >= FILE_ROWS)
                fingerprints |= fingerprints_of(accepted)
        return ticks, erased, fingerprints if ticks else {}


def _group_drives(drives: Iterable[MeasuredDrive]) -> Iterator[list[MeasuredDrive]]:
    """Yield groups of drives with the rows of a data file; the last group may have fewer."""
    group: list[MeasuredDrive] = []
    for drive in drives:
        group.append(drive)
        if _count_ticks(group) >= FILE_ROWS:
            yield group
            group = []
    if group:
        yield group


def _count_ticks(drives: Iterable[MeasuredDrive]) -> int:
    return sum(drive.ticks.size for drive in drives)


# Dry run: files are read as above, and nothing is written.


def preview_logs(logs: Iterable[Path], mapping: Mapping) -> list[Preview]:
    """Read logs and check them as `ingest_files` does, and store nothing.

    Raises `InputError`.
    """
    previews: list[Preview] = []
    for batch in _batches(map(IngestTask, logs)):
        results, longest = zip(*(_preview_log(task.file, mapping) for task in batch), strict=True)
        faults = check_longest(mapping, longest)
        pairs = zip(results, faults, strict=True)
        previews += [preview.with_faults(of_file) for preview, of_file in pairs]
    return previews


def _preview_log(log: Path, mapping: Mapping) -> tuple[Preview, MeasuredDrive | None]:
    """Return the preview of a log and its longest drive. Raises `InputError`."""
    ends: dict[str, list[int]] = {name: [] for name in mapping.signal_names}
    values: Counter[str] = Counter()
    with open_measured(log, mapping) as stream:
        for drive in stream.drives():
            for name, counts in drive.counts.items():
                values[name] += len(counts) - counts.null_count
                ends[name] += [
                    end for end in pc.min_max(counts).as_py().values() if end is not None
                ]
        suspicions = stream.suspicions()  # may read the file again
    ranges = []
    for name, bounds in ends.items():
        signal = mapping.signal_catalog[name]
        scale = float(signal.scale)
        low, high = (scale * min(bounds), scale * max(bounds)) if bounds else (np.nan, np.nan)
        missing = 1 - values[name] / max(stream.counts.ticks, 1)
        ranges.append(SignalRange(name, signal.unit, low, high, missing))
    preview = Preview(str(log), stream.counts, suspicions, ranges=tuple(ranges))
    return preview, stream.longest


CHECKED_TICKS, MIN_CHECKED_TICKS = 60_000, 6_000
"""Ticks to check: in a batch of files at most ten minutes, but in each file a minute."""


def check_longest(
    mapping: Mapping, drives: Sequence[MeasuredDrive | None]
) -> list[tuple[Fault, ...]]:
    """Check the longest drive of each file; return the faults by file.

    A fault of several drives is reported once, for the longest of them. `CHECKED_TICKS` bounds the
    time of a batch: a check takes as long as loading a small file.
    """
    present = [(place, drive) for place, drive in enumerate(drives) if drive is not None]
    present.sort(key=lambda pair: pair[1].ticks.size, reverse=True)
    from_velocities = mapping.label is not None and mapping.label.from_velocities
    same_faults: dict[tuple[str, tuple[str, ...]], list[tuple[int, Fault]]] = {}
    for place, drive in present:
        ticks = max(CHECKED_TICKS // len(present), MIN_CHECKED_TICKS)
        signals = signals_of(mapping.signal_catalog, drive, ticks)
        for fault in check_plausibility(
            mapping.signal_catalog, signals, from_velocities=from_velocities
        ):
            same_faults.setdefault((fault.kind, fault.signals), []).append((place, fault))
    faults: list[tuple[Fault, ...]] = [()] * len(drives)
    for (place, fault), *repeats in same_faults.values():
        also = f", as in {pluralize(len(repeats), 'other file')}" if repeats else ""
        faults[place] += (dataclasses.replace(fault, figure=fault.figure + also),)
    return faults


def signals_of(signals: SignalCatalog, drive: MeasuredDrive, ticks: int) -> Signals:
    """Return the signals of the first ticks of a drive, as `check_plausibility` reads them."""
    number = int(np.searchsorted(drive.ticks, drive.ticks[0] + ticks))
    counts = {name: as_floats(values[:number]) for name, values in drive.counts.items()}
    return to_regular_grid(signals, drive.ticks[:number], counts)


# Writing data files of bounded size.

WRITERS = 2
"""Data files written at the same time; encoding them takes most of the time of an ingest."""


class DataFiles:
    """The data files of a batch in one table."""

    def __init__(self, table: Table, threads: ThreadPoolExecutor) -> None:
        """Take the table, and threads to write with."""
        self._table, self._threads = table, threads
        self._written: list[tuple[str, Future[list[AddAction]]]] = []
        """Data files, each with the digest of its log, or "" for rows of several logs."""
        self._waiting: dict[str, pa.Table] = {}
        """Rows that share a data file with those of other logs, by digest."""
        self.digests = set[str]()

    def add(self, digest: str, rows: pa.Table, *, full: bool) -> None:
        """Write rows of a log to a separate data file if `full`, else to a shared one later."""
        if not rows.num_rows:
            return
        self.digests.add(digest)
        if full:
            number = 1 + sum(log_digest == digest for log_digest, _ in self._written)
            self._begin(f"measured-{digest[:24]}-{number}", [rows], digest)
        else:
            self._waiting[digest] = rows

    def end_log(self) -> None:
        """Write the rows that wait, if they fill a data file."""
        if sum(rows.num_rows for rows in self._waiting.values()) >= FILE_ROWS:
            self._write_waiting()

    def discard(self, digest: str) -> None:
        """Delete the data files and rows of a log whose reading failed."""
        for log_digest, writing in self._written:
            if log_digest == digest and writing.exception() is None:
                self._table.discard(writing.result())
        self._written = [pair for pair in self._written if pair[0] != digest]
        self._waiting.pop(digest, None)
        self.digests.discard(digest)

    def finish(self) -> list[AddAction]:
        """Wait for all data files and return them."""
        self._write_waiting()
        return [file for _, writing in self._written for file in writing.result()]

    def _write_waiting(self) -> None:
        """Write waiting rows in the order of their logs' digests, which is that of drive names."""
        if self._waiting:
            digests, rows = zip(*sorted(self._waiting.items()), strict=True)
            self._begin(f"measured-{combine_digests(digests)[:24]}", list(rows))
            self._waiting = {}

    def _begin(self, name: str, rows: list[pa.Table], digest: str = "") -> None:
        """Start writing rows, after the oldest of `WRITERS` files under way has ended."""
        if len(self._written) >= WRITERS:
            self._written[-WRITERS][1].result()
        self._written.append((digest, self._threads.submit(self._write, name, rows)))

    def _write(self, name: str, rows: list[pa.Table]) -> list[AddAction]:
        table = pa.concat_tables(rows).unify_dictionaries()
        days = table["day"].unique() if "day" in table.column_names else pa.array([None])
        encoded = {}
        for day in days:  # rejected rows have none
            of_day = table if len(days) == 1 else table.filter(pc.equal(table["day"], day))
            encoded[day.as_py()] = self._table.encode(of_day)
        del table, of_day  # frees memory during slow writes
        return [self._table.put(name, content, day) for day, content in encoded.items()]


def log_table(drives: Sequence[MeasuredDrive], mapping: Mapping) -> pa.Table:
    """Return the rows of `logs` for these drives; strings are dictionary-encoded."""
    signals, measured = mapping.signal_catalog, set(mapping.signal_names)
    sizes = [drive.ticks.size for drive in drives]
    drive_schema = pa.schema([signals.log_schema.field("day"), *signals.drive_schema])
    metadata = [{name: drive.metadata.get(name) for name in drive_schema.names} for drive in drives]
    # Polars converts the objects: Arrow would import pandas for it, if that is installed.
    schema = pl.DataFrame(drive_schema.empty_table()).schema
    drive_table = pl.DataFrame(metadata, schema, strict=False).to_arrow().cast(drive_schema)
    columns: dict[str, pa.ChunkedArray] = {}
    for column in drive_schema:
        values = drive_table[column.name].combine_chunks()
        if pa.types.is_string(column.type):
            encoded = values.dictionary_encode()
            codes = _repeat(encoded.indices, sizes)
            rows = pa.DictionaryArray.from_arrays(codes, encoded.dictionary, safe=False)
        else:
            rows = _repeat(values, sizes)
        columns[column.name] = pa.chunked_array([rows])
    columns["tick"] = pa.chunked_array([as_arrow(drive.ticks) for drive in drives], pa.int32())
    for name in signals.signals:
        if name in measured:
            columns[name] = pa.chunked_array([drive.counts[name] for drive in drives])
        elif name not in signals.extras:
            columns[name] = pa.nulls(sum(sizes), pa.int16())
    return pa.table(columns)


def _repeat(values: pa.Array, sizes: Sequence[int]) -> pa.Array:
    """Repeat each value by its size, in a fifth of the time that `take` needs."""
    if values.null_count == len(values):
        return pa.nulls(sum(sizes), values.type)
    column = pl.Series(values).to_physical()
    absent = np.repeat(column.is_null().to_numpy(), sizes) if values.null_count else None
    repeated = np.repeat(column.fill_null(0).to_numpy(), sizes)
    return as_arrow(repeated, absent).view(values.type)


# Commits: rejected rows first, then drives.


def commit_batch(
    warehouse: Warehouse,
    batch: WrittenBatch,
    write_again: Callable[[], WrittenBatch],
    note: dict[str, str],
    build_removal: BuildRemoval | None = None,
) -> tuple[WrittenBatch, frozenset[str]]:
    """Commit a batch to both tables, together with the removal of the sources that it replaces.

    A batch is written again whenever it is outdated: by an erasure, or by another process's commit
    of the same recording. Returns the batch as committed, and the digests that the logs lacked.
    """
    tables = tables_of(warehouse)

    def commit_to(name: TableName) -> frozenset[str]:
        nonlocal batch  # a batch that is written again stays for later attempts, and for the logs
        snapshot = tables[name].snapshot()
        while _is_outdated(warehouse, batch, name, snapshot):
            for other, table in tables.items():
                table.discard(batch.added[other])  # except committed ones
            batch = write_again()
            snapshot = tables[name].snapshot()
        replaced = {source for file in batch.files for source in file.replaced}
        added, removal = batch.added[name], Change()
        if replaced and build_removal and batch.added["logs"]:
            removal = build_removal(name, snapshot, replaced)
        if not (added or removal.remove):
            return frozenset()
        transactions = [*removal.transactions, *map(file_transaction, batch.digests[name])]
        if name == "logs":
            for file in batch.files:
                transactions += [AppTransaction(n, v) for n, v in file.fingerprints.items()]
        # New fingerprints override the removal, which withdraws those of the replaced drives.
        by_name = {transaction.name: transaction for transaction in transactions}
        change = Change([*added, *removal.add], removal.remove, tuple(by_name.values()), note)
        try:
            snapshot.commit(change)
        except ConflictError:
            tables[name].discard(removal.add)
            raise
        return frozenset(batch.digests[name])

    retry_conflicts(partial(commit_to, "quarantine"))
    new = retry_conflicts(partial(commit_to, "logs"))
    return batch, new


def _is_outdated(
    warehouse: Warehouse, batch: WrittenBatch, name: TableName, snapshot: Snapshot
) -> bool:
    """Return True if an erasure or a commit since the batch was written affects its rows."""
    # Read after the snapshot: an erasure that begins from now on makes this commit a conflict.
    if ErasureLog(warehouse.root).begun() != batch.erasures:
        return True
    if any(snapshot.has_committed(FILE_PREFIX + digest) for digest in batch.digests[name]):
        return True
    files = [file for file in batch.files if file.fingerprints and name == "logs"]
    stored = Fingerprints(snapshot.transactions if files else {})
    return any(stored.find(file.fingerprints) - file.stored_sources for file in files)
