"""Looks for drives that are not whole, and for Gram rows that are not those of their logs."""

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.compute.tasks import run_tasks
from fleet_slip.delta import TableFile
from fleet_slip.grams.received.counted_sets import CountedSet, counted_by_identity
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.rows.check_grams import (
    DriveGrams,
    differing_drives,
    find_gram_files,
    grams_by_blocks,
    read_counts,
    stored_grams,
)
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table, is_received
from fleet_slip.maintenance.verify_files import Verification
from fleet_slip.resources import read_sql
from fleet_slip.warehouse.database import database_errors, open_database
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

SAMPLE = 4
"""Log files whose Gram rows are computed again, evenly chosen, unless all are asked for."""


def verify_drives(warehouse: Warehouse, files: Sequence[TableFile], report: Verification) -> None:
    """Look for drives that are not whole, or stand in several files."""
    paths = [warehouse.logs.uri(file.path) for file in files]
    database = open_database(reading=warehouse.logs.folder)
    with database, database_errors("verifying the drives"):
        database.execute("SET VARIABLE log_files = $files", {"files": paths})
        rows = database.execute(read_sql("jobs", "verify_drives.sql")).fetchall()
    for drive, in_files, beginnings, n, file in rows:
        problem = (
            f"{n:,} rows in {number_of(in_files, 'file')} with {number_of(beginnings, 'row')} of "
            f"tick 0; one is {file}"
        )
        report.note("drive", drive, problem)


@dataclass(frozen=True)
class SoundFiles:
    """The files of a data root whose bytes are what they must be, and what the logs consist of."""

    logs: Sequence[TableFile]
    grams: Sequence[TableFile]
    active: Collection[str]
    """Paths of all active log files, sound or not."""


def verify_grams(
    warehouse: Warehouse,
    sound: SoundFiles,
    report: Verification,
    full: bool,
    executor: Executor | None,
) -> None:
    """Look for Gram rows that are doubled, missing, left over, or wrong (in a sample, or all)."""
    _verify_unique(warehouse, sound.grams, report)
    _verify_each(warehouse, sound.grams, report)
    where = find_gram_files(warehouse, sound.grams)
    covered = [file for file in sound.logs if file.path in where]
    step = 1 if full else max(1, len(covered) // SAMPLE)
    by_place: dict[tuple[str, ...], list[TableFile]] = {}
    for file in covered[::step]:
        by_place.setdefault(where[file.path], []).append(file)
    for places, files in by_place.items():
        stored = stored_grams(warehouse, files, places)
        task = partial(_compute_grams, warehouse)
        for file, computed in run_tasks(executor, task, files, _name_task):
            for drive in differing_drives(stored[file.path], computed):
                problem = f"the stored Gram row of drive {drive} is not that of its rows"
                report.note("gram", f"logs/{file.path}", problem)
            report.log_files_recomputed += 1
    missing = len(sound.logs) - len(covered)
    stale = where.keys() - set(sound.active)
    if missing or stale:
        problem = (
            f"no Gram rows of {number_of(missing, 'log file')}, Gram rows of {len(stale)} that "
            "are gone"
        )
        report.note("backlog", "grams", f"{problem}; run: fleet-slip gram")


def _verify_unique(warehouse: Warehouse, grams: Sequence[TableFile], report: Verification) -> None:
    paths = [warehouse.grams.uri(file.path) for file in grams]
    database = open_database(reading=warehouse.grams.folder)
    with database, database_errors("verifying the Gram rows"):
        database.execute("SET VARIABLE gram_files = $files", {"files": paths})
        twice = database.execute(read_sql("jobs", "verify_grams.sql")).fetchall()
    for identity, file, drive, n in twice:
        problem = f"the Gram row {identity} of drive {drive} stands {n} times"
        report.note("gram", f"logs/{file}", problem)


def _verify_each(warehouse: Warehouse, grams: Sequence[TableFile], report: Verification) -> None:
    """Look for received Gram rows that no counts or drives can have."""
    for file in grams:
        rows = warehouse.grams.read(file.path)
        for drive, problem in _impossible(rows):
            told = f"the Gram row that a car sent of drive {drive} {problem}"
            report.note("gram", f"grams/{file.path}", told)


def _impossible(rows: pa.Table) -> Iterator[tuple[str, str]]:
    """Yield the drives whose Gram rows, counted in the car, cannot be, and why."""
    came = rows.filter(is_received(rows))
    for identity in came["feature_set"].unique().to_pylist():
        one = counted_by_identity().get(identity)
        if one is None:  # it is defined otherwise today
            continue
        some = came.filter(pc.equal(came["feature_set"], identity)).combine_chunks()
        for batch in some.to_batches():
            for signals, alike, _ in by_signals(batch):
                yield from _impossible_among(one, signals, alike)


def _impossible_among(
    one: CountedSet, signals: str, rows: pa.RecordBatch
) -> Iterator[tuple[str, str]]:
    drives, names = rows["drive_id"].to_pylist(), signals.split(",") if signals else []
    if not set(names) <= set(one.columns):
        yield from ((drive, "has signals that there are not") for drive in drives)
    elif names:
        told, ranges = gram_table(signals, rows), one.ranges_of(names)
        for why, at in find_impossible(told.n, told.sums, told.products, ranges).items():
            yield from ((drives[place], why) for place in at.tolist())


def _compute_grams(warehouse: Warehouse, file: TableFile) -> DriveGrams:
    return grams_by_blocks(warehouse, read_counts(warehouse, file))


def _name_task(file: TableFile) -> str:
    return f"the Gram rows of {file.path}"
