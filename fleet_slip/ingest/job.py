"""Brings measured logs into the warehouse; the same file through the same mapping lands once."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from fleet_slip.base import Progress, no_progress, number_of
from fleet_slip.catalogue.faults import Fault
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.ingest.load import (
    AskedFile,
    FileOutcome,
    KnownFiles,
    Replace,
    TakeOut,
    WrittenBatch,
    are_gone,
    commit_batch,
    unit_of,
    write_batch,
)
from fleet_slip.ingest.log_files import Log, StoredParts
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.stream import IngestCounts
from fleet_slip.storage.folder import StoredFile
from fleet_slip.warehouse.tables import Warehouse

BATCH_BYTES = 2**24
"""Files are read, written and committed together up to this size."""
BATCH_FILES = 500
FAILURES_SHOWN = 5

Batch: TypeAlias = tuple[AskedFile, ...]


@dataclass(frozen=True)
class IngestReport:
    """What became of one file."""

    file: str
    new: bool
    counts: IngestCounts
    drives_forgotten: int = 0
    """Drives that were left out: of cars that were forgotten, or forgotten themselves."""
    suspicions: tuple[Fault, ...] = ()
    """What looks wrong in its longest drive; of small files that land together, in one of all."""
    drives_replaced: int = 0
    """Drives that gave way to it: its recording, from another file or through another mapping."""

    @property
    def alarms(self) -> tuple[Fault, ...]:
        """What looks wrong and does harm."""
        return tuple(one for one in self.suspicions if one.does_harm)

    def as_dict(self) -> dict[str, Any]:
        """Return what `ingest --json` prints."""
        return {
            "file": self.file,
            "new": self.new,
            "rows_read": self.counts.rows_read,
            "rows_left_out": self.counts.rows_left_out,
            "rows_kept": self.counts.rows_kept,
            "rows_quarantined": sum(self.counts.quarantined.values()),
            "quarantined": self.counts.quarantined,
            "drives": self.counts.drives,
            "drives_forgotten": self.drives_forgotten,
            "drives_replaced": self.drives_replaced,
            "drives_resampled": self.counts.drives_resampled,
            "ticks": self.counts.ticks,
            "suspicions": [vars(one) for one in self.suspicions],
        }


def ingest_files(
    warehouse: Warehouse,
    files: Iterable[Log],
    mapping: Mapping,
    executor: Executor | None = None,
    known: KnownFiles | None = None,
    progress: Progress = no_progress,
    replace: Replace = "no",
    take_out: TakeOut | None = None,
    failures: list[InputError] | None = None,
) -> Iterator[IngestReport]:
    """Ingest files, and yield a report of each as it is committed; small files land together.

    An executor's workers read batches in any order, but its threads none of large files, each of
    which keeps all cores busy. `known` remembers what is in. A recording that is there is refused,
    unless it is to be replaced: then `take_out` takes it out in the same commit. `progress` counts
    bytes of each file that this process reads.

    Errors of files come at the end: `failures` takes them, or `InputError` tells of all, or
    `RepeatedError` where all are there already. Raises `ClusterError` for files that workers died
    of.
    """
    write = partial(write_batch, warehouse, mapping, replace=replace)
    if executor is None:
        write = partial(write, progress=progress)
    warehouse.logs.require_writable(mapping.signal_names)
    failed: list[InputError] = []
    asked = (AskedFile(file, known.digest_of(file) if known else None) for file in files)
    for batch, written in _written(executor, write, _batches(asked)):
        # Not the file's name: it may name a car, and the Delta log outlives what is forgotten.
        note = {"job": "ingest", "mapping": mapping.name, "digest": written.digest}
        committed, new = commit_batch(warehouse, written, partial(write, batch), note, take_out)
        failed += committed.failures
        for outcome in committed.outcomes:
            yield _report(warehouse, outcome, new)
            new -= {unit_of(outcome.digest).name}  # the same content in another file is not new
            if known is not None:
                known.remember(outcome.file, outcome.digest)
    if failures is not None:
        failures += failed
    elif failed:
        raise joined(failed)


def _written(
    executor: Executor | None, write: Callable[[Batch], WrittenBatch], batches: Iterable[Batch]
) -> Iterator[tuple[Batch, WrittenBatch]]:
    """Yield batches as they are written."""
    alone: list[Batch] = []
    if isinstance(executor, ThreadPoolExecutor):
        together: list[Batch] = []
        for batch in batches:
            (alone if _size_of(batch[0].file) >= BATCH_BYTES else together).append(batch)
        batches = together
    yield from run_tasks(executor, write, batches, lambda batch: str(batch[0].file))
    yield from run_tasks(None, write, alone, str)


def _batches(files: Iterable[AskedFile]) -> Iterator[Batch]:
    """Group files, in their order, into batches of `BATCH_BYTES` and one file at least."""
    batch: list[AskedFile] = []
    size = 0
    for asked in files:
        more = _size_of(asked.file)
        if batch and (size + more > BATCH_BYTES or len(batch) >= BATCH_FILES):
            yield tuple(batch)
            batch, size = [], 0
        batch.append(asked)
        size += more
    if batch:
        yield tuple(batch)


def _size_of(log: Log) -> int:
    if isinstance(log, StoredFile):
        return log.size_bytes
    if isinstance(log, StoredParts):
        return BATCH_BYTES  # or more: it is a batch of its own
    try:
        return log.stat().st_size
    except OSError:
        return 0  # whoever reads it says what is wrong


def _report(warehouse: Warehouse, outcome: FileOutcome, new: frozenset[str]) -> IngestReport:
    is_new = unit_of(outcome.digest).name in new
    if not is_new and not outcome.left_out and are_gone(warehouse, outcome.digest):
        outcome.left_out = outcome.counts.drives
        outcome.counts = outcome.counts.without(outcome.left_out, 0)
    suspicions = outcome.suspicions if is_new else ()
    return IngestReport(
        str(outcome.file),
        is_new,
        outcome.counts,
        outcome.left_out,
        suspicions,
        outcome.drives_replaced if is_new else 0,
    )


def joined(failures: list[InputError]) -> InputError:
    """Return one error that tells of all."""
    if len(failures) == 1:
        return failures[0]
    first = " ".join(map(str, failures[:FAILURES_SHOWN]))
    more = len(failures) - FAILURES_SHOWN
    kind = RepeatedError if all(isinstance(o, RepeatedError) for o in failures) else InputError
    return kind(
        f"{number_of(len(failures), 'file')} cannot be used; all others are in. {first}"
        + (f" And {more:,} more." if more > 0 else "")
    )
