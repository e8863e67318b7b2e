"""Gram rows of log files: plain feature sets by `jobs/gram.sql`, windows by the compiled kernel.

The kernel sums the rows, blocks and course changes of each drive.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from functools import partial
from itertools import pairwise
from math import ceil
from os import cpu_count
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import (
    COURSE,
    COURSE_LATE,
    TURNED_DIVISOR,
    CourseUnits,
    course_units,
    split_late,
)
from fleet_slip.catalog.definitions import COUNT_BITS, Slope, rows_behind
from fleet_slip.catalog.features import PLAIN, FeatureSet
from fleet_slip.catalog.signals import HALF_TURN, SignalCatalog
from fleet_slip.columns.column_sql import with_absent, with_columns
from fleet_slip.columns.drive_columns import BLOCK_ROWS, ColumnPlan, DriveCounts
from fleet_slip.compute.tasks import LocalThreads, in_flight, run_tasks
from fleet_slip.errors import DataError, QuestionError, StorageError
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import TableFile, absent_columns
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.warehouse import Warehouse

CourseDelays = Mapping[str, int] | None
"""Delay of the course of each car in `LATE_PARTS` of a tick; 0 for other cars."""

# Rows of drives, one drive at a time in the order of time, from log files or a query.


def read_drives(warehouse: Warehouse, file: TableFile, plan: ColumnPlan) -> Iterator[DriveCounts]:
    """Yield the drives of a log file, with their metadata as facts and rows sorted by time.

    As in SQL, a drive without a row of tick 0 is skipped.
    """
    drive_columns = tuple(warehouse.catalog.signals.drive)
    columns = [n for n in (*drive_columns, "tick", *plan.signals) if n in file.null_counts]
    for drive in rows_by_drive(warehouse.logs.read(file.path, columns)):
        ticks = drive["tick"].to_numpy()
        if (ticks[1:] < ticks[:-1]).any():
            order = np.argsort(ticks, kind="stable")
            drive, ticks = drive.take(order), ticks[order]  # noqa: PLW2901
        start = int(np.searchsorted(ticks, 0))
        if start < len(ticks) and ticks[start] == 0:
            metadata = {
                name: drive[name][start].as_py() if name in columns else None
                for name in drive_columns
            }
            yield counts_of(drive, plan, metadata)


def counts_of(
    rows: pa.Table,
    plan: ColumnPlan,
    facts: Mapping[str, Any] | None = None,
    parameters: Mapping[str, int] | None = None,
) -> DriveCounts:
    """Return the rows of a drive, sorted by time, as the input of a column plan.

    `facts` are the metadata that the plan uses, by default those of the first row. `parameters` are
    the counts of the calibration parameters of the car.
    """
    counts, present = {}, {}
    for name in plan.signals:
        if name not in rows.column_names:
            counts[name] = np.zeros(len(rows), dtype=np.int16)
            present[name] = np.zeros(len(rows), dtype=np.bool_)
            continue
        column = rows[name].combine_chunks()
        if column.null_count:
            present[name] = column.is_valid().to_numpy(zero_copy_only=False)
            column = column.fill_null(0)
        counts[name] = column.to_numpy()
    if facts is None:
        facts = {name: rows[name][0].as_py() for name in plan.facts}
    return DriveCounts(rows["tick"].to_numpy(), counts, present, facts, parameters or {})


def drives_of_stream(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows of each drive from batches that are sorted by drive."""
    segments: list[pa.Table] = []
    for batch in batches:
        for segment in rows_by_drive(pa.Table.from_batches([batch])):
            if segments and segments[0]["drive_id"][0] != segment["drive_id"][0]:
                yield pa.concat_tables(segments)
                segments = []
            segments.append(segment)
    if segments:
        yield pa.concat_tables(segments)


def rows_by_drive(rows: pa.Table) -> Iterator[pa.Table]:
    """Yield the rows of each drive, in their order."""
    ids = rows["drive_id"].combine_chunks()
    if not pa.types.is_dictionary(ids.type):
        ids = pc.dictionary_encode(ids)
    drive_of_row = ids.indices.to_numpy()
    starts = np.flatnonzero(np.diff(drive_of_row, prepend=-1))
    if len(starts) > len(np.unique(drive_of_row[starts])):  # the rows of drives are mixed
        order = np.argsort(drive_of_row, kind="stable")
        rows, drive_of_row = rows.take(order), drive_of_row[order]
        starts = np.flatnonzero(np.diff(drive_of_row, prepend=-1))
    for start, stop in pairwise([*starts.tolist(), rows.num_rows]):
        yield rows.slice(start, stop - start)


def block_name(feature_set: FeatureSet, number: int) -> str | None:
    """Return the name of a block of a drive; None for an undivided drive.

    A block is a block of time, or one of several durations of changes. Names sort as numbers do.
    """
    if feature_set.block_ticks:
        return f"block {number + 1:04}"
    durations = feature_set.change_s
    return f"{durations[number]:f} s" if len(durations) > 1 else None


# Gram rows of any feature set by the kernel: equal to those by SQL, faster.
#
# Each drive is read once, in the order of time. Columns are integers below 2^19 in binary64. Their
# products and sums over blocks stay below 2^53, and so are exact in any order. Totals have 64 bits.

_INT64 = 2**63


def by_kernel(
    warehouse: Warehouse, files: Sequence[TableFile], feature_set: str, delays: CourseDelays = None
) -> pa.Table:
    """Return the Gram rows of log files for a feature set, sorted as by `jobs/gram.sql`.

    Raises `DataError` for a drive whose ticks windows cannot use, and `StorageError` for sums of
    more than 64 bits.
    """
    catalog = warehouse.catalog
    resolved, model = catalog.feature_set(feature_set), catalog.first_stage_model(feature_set)
    plan = ColumnPlan.of_set(catalog, feature_set)
    plans: dict[str | None, ColumnPlan] = {None: plan}
    identity = catalog.identity(feature_set)
    schema = warehouse.computed_schema(in_time=resolved.in_time)
    rows: list[dict[str, Any]] = []
    # Files run in parallel; further threads of the BLAS would compete with them.
    with threadpool_limits(1, user_api="blas"):
        for file in sorted(files, key=lambda file: file.path):
            drives = read_drives(warehouse, file, plan)
            for drive in sorted(drives, key=lambda drive: str(drive.facts["drive_id"])):
                fold = model.fold_of(str(drive.facts["drive_id"])) if model else None
                if fold not in plans:
                    plans[fold] = ColumnPlan.of_set(catalog, feature_set, fold)
                delay = (delays or {}).get(drive.facts["vehicle_id"])
                metadata = {**drive.facts, "feature_set": identity, COURSE_LATE: delay}
                metadata |= {"file": file.path, "day": file.day}
                rows += _rows_of_drive(catalog.signals, plans[fold], resolved, drive, metadata)
    return pa.Table.from_pylist(rows, schema=schema)


def _rows_of_drive(
    signals: SignalCatalog,
    plan: ColumnPlan,
    feature_set: FeatureSet,
    drive: DriveCounts,
    metadata: Mapping[str, Any],
) -> Iterator[dict[str, Any]]:
    try:
        if feature_set.change_ticks:
            delay = (metadata[COURSE_LATE] or 0) if feature_set.in_time else 0
            sums = change_sums(signals, plan, drive, feature_set.change_ticks, delay)
        else:
            sums = drive_sums(plan, feature_set, drive)
    except DataError as error:
        raise DataError(f"{metadata['file']}: drive {metadata['drive_id']}: {error}") from None
    return gram_rows(sums, feature_set, metadata)


def gram_rows(
    sums_by_pattern: "Mapping[Pattern, BlockSums]",
    feature_set: FeatureSet,
    metadata: Mapping[str, Any],
) -> Iterator[dict[str, Any]]:
    """Yield the Gram rows of the sums of a drive with its metadata, sorted as by SQL."""
    for absent, block in sorted(sums_by_pattern):
        sums = sums_by_pattern[absent, block]
        names = [name for i, name in enumerate(feature_set.columns) if not absent >> i & 1]
        yield {
            **metadata,
            "part": block_name(feature_set, block),
            "signals": ",".join(names),
            "n": sums.n,
            "clipped": sums.clipped,
            "sums": sums.sums,
            "products": sums.products[np.tril_indices(len(names))],
        }


class BlockSums:
    """Sums over the rows of a drive, or of a block of it, that have the same columns."""

    def __init__(self, size: int) -> None:
        self.n, self.clipped = 0, 0
        self.sums = np.zeros(size, dtype=np.int64)
        self.products = np.zeros((size, size), dtype=np.int64)

    def add(self, values: FloatArray, clipped: FloatArray) -> None:
        """Add complete rows, shape (columns, rows), and the number of clipped values of each.

        Sums of at most `BLOCK_ROWS` rows are exact. Columns of zeros, such as those of a closed
        gate, are skipped.
        """
        self.n += values.shape[1]
        self.clipped += int(clipped.sum())
        self.sums += values.sum(axis=1).astype(np.int64)
        nonzero = values.any(axis=1)
        values = values if nonzero.all() else values[nonzero]
        self.products[np.ix_(nonzero, nonzero)] += (values @ values.T).astype(np.int64)


Pattern = tuple[int, int]
"""Bit mask of the columns that rows lack, and number of the block of the drive."""


def drive_sums(
    plan: ColumnPlan, feature_set: FeatureSet, counts: DriveCounts
) -> dict[Pattern, BlockSums]:
    """Return the sums of the rows of a drive by pattern; raises as `by_kernel`."""
    _require_64_bits(len(counts.ticks), max(plan.limits))
    sums: dict[Pattern, BlockSums] = {}
    ticks = counts.ticks.astype(np.int64)
    size = feature_set.block_ticks
    block_of_row = ticks // size if size else np.zeros_like(ticks)
    for rows, values, clipped in plan.blocks(counts):
        _add_by_pattern(sums, values, clipped, block_of_row[rows])
    return sums


def change_sums(
    signals: SignalCatalog,
    plan: ColumnPlan,
    counts: DriveCounts,
    durations: Sequence[int],
    delay: int = 0,
) -> dict[Pattern, BlockSums]:
    """Return the sums of the changes of a drive by pattern; a block is a duration in ticks."""
    _require_64_bits(len(counts.ticks), 2 * max(plan.limits))
    fixes = Fixes(course_units(signals), plan, counts, delay)
    sums: dict[Pattern, BlockSums] = {}
    for block, duration in enumerate(durations):
        rows, values, clipped = fixes.changes(duration)
        _add_by_pattern(sums, values, clipped, np.full(len(rows), block))
    return sums


def _require_64_bits(rows: int, largest: int) -> None:
    if rows * largest**2 >= _INT64:
        raise StorageError(f"the drive has {rows:,} rows: too many for 64-bit sums.")


def _add_by_pattern(
    sums: dict[Pattern, BlockSums], values: FloatArray, clipped: FloatArray, blocks: IntArray
) -> None:
    """Add rows to the sums of their pattern, at most `BLOCK_ROWS` at a time."""
    for (absent, block), rows in _find_patterns(values, blocks):
        present = [i for i in range(len(values)) if not absent >> i & 1]
        total = sums.setdefault((absent, block), BlockSums(len(present)))
        for start in range(0, len(rows), BLOCK_ROWS):
            chunk = rows[start : start + BLOCK_ROWS]
            selected = values if len(chunk) == len(clipped) else values.take(chunk, axis=1)
            complete = selected if len(present) == len(selected) else selected[present]
            total.add(complete, clipped[chunk])


def _find_patterns(
    values: FloatArray, blocks: IntArray
) -> Iterator[tuple[Pattern, NDArray[np.int64]]]:
    """Yield each pattern of missing columns and block, and its rows."""
    is_missing = np.isnan(values)
    incomplete = np.flatnonzero(is_missing.any(axis=0))  # usually few: only these are sorted
    pattern_of_row, masks = np.zeros(values.shape[1], dtype=np.int64), [0]
    if len(incomplete):
        packed = np.packbits(is_missing[:, incomplete], axis=0, bitorder="little")
        patterns, indices = np.unique(packed, axis=1, return_inverse=True)
        masks += [int.from_bytes(column.tobytes(), "little") for column in patterns.T]
        pattern_of_row[incomplete] = 1 + indices.reshape(-1)
    key_of_row = blocks * len(masks) + pattern_of_row
    for key in np.unique(key_of_row).tolist():
        block, pattern = divmod(key, len(masks))
        yield (masks[pattern], block), np.flatnonzero(key_of_row == key)


# Changes between satellite fixes of one drive, as `catalog/course.py` defines them.
#
# Only rows with a fix are in memory: at most one in ten.


class Fixes:
    """Rows of a drive that have a fix."""

    def __init__(
        self, units: CourseUnits, plan: ColumnPlan, drive: DriveCounts, delay: int = 0
    ) -> None:
        """Find the fixes of a drive whose course is late by `delay` parts of a tick.

        Course and yaw rate are the last columns of the plan.
        """
        self.units = units
        self.ticks = drive.ticks.astype(np.int64)
        delay_ticks, self.gain = split_late(delay)
        self.rows, self.course = _find_fixes(drive, self.ticks, delay_ticks)
        self.yaw_rate = np.empty(len(self.ticks))  # of all rows, NaN where it is missing
        values: list[FloatArray] = []
        clipped: list[FloatArray] = []
        self.first_clipped = np.zeros(0)
        for rows, block, block_clipped in plan.blocks(drive):
            self.yaw_rate[rows] = block[-1]
            begin, end = np.searchsorted(self.rows, (rows.start, rows.stop))
            fixed = self.rows[begin:end] - rows.start
            values.append(block[:-2].take(fixed, axis=1))
            clipped.append(block_clipped[fixed])
            if not rows.start:
                self.first_clipped = block_clipped[:1].copy()
        self.counts, self.clipped = np.concatenate(values, axis=1), np.concatenate(clipped)

    def changes(self, duration: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the changes between fixes that are `duration` ticks apart.

        Returns the rows of the later fixes, the columns of the changes, and the number of clipped
        values of each change. The columns have the shape (columns, changes). The last ones are
        `AUXILIARY` and the label. Missing values are NaN.
        """
        rows, yaw_rate, units = self.rows, self.yaw_rate, self.units
        before, now = _pair_fixes(self.ticks[rows], duration)
        turned, complete = _twice_turned(self.ticks, yaw_rate, rows[before], rows[now])
        before, now, turned = before[complete], now[complete], turned[complete]
        by_delay = self.gain * (yaw_rate[rows[now]] - yaw_rate[rows[before]]).astype(np.int64)
        course_change = self.course[now] - self.course[before]
        change, plausible = _sideslip_change(units, course_change, turned, by_delay)
        before, now, turned, change = (v[plausible] for v in (before, now, turned, change))
        # Straight driving by the yaw rate at both fixes and in between.
        fastest = np.maximum(np.abs(yaw_rate[rows[before]]), np.abs(yaw_rate[rows[now]]))
        straight = (fastest <= units.slow) & (np.abs(turned) <= units.unturned)
        auxiliary = [_divide_rounded(turned, TURNED_DIVISOR), straight, straight * change]
        # A row without a change precedes the changes: it represents drives without a course.
        is_start = self.ticks[:1] == 0
        offset, size = int(is_start.sum()), len(self.counts)
        columns = np.full((size + len(auxiliary) + 1, offset + len(now)), np.nan)
        columns[:size, offset:] = self.counts.take(now, axis=1)
        columns[:size, offset:] -= self.counts.take(before, axis=1)
        columns[size:, offset:] = [*auxiliary, change]
        clipped = np.concatenate([self.first_clipped[is_start], self.clipped[now]])
        return np.concatenate([np.flatnonzero(is_start), rows[now]]), columns, clipped


def _find_fixes(drive: DriveCounts, ticks: IntArray, delay_ticks: int) -> tuple[IntArray, IntArray]:
    """Return the rows of the fixes, `delay_ticks` before they arrive, and the course."""
    fixed = np.flatnonzero(drive.present.get(COURSE, np.ones(len(ticks), dtype=np.bool_)))
    rows = np.searchsorted(ticks, ticks[fixed] - delay_ticks)
    exists = ticks[np.minimum(rows, len(ticks) - 1)] == ticks[fixed] - delay_ticks
    return rows[exists], drive.counts[COURSE][fixed[exists]].astype(np.int64)


def _pair_fixes(ticks: IntArray, duration: int) -> tuple[IntArray, IntArray]:
    """Return the indices of the fixes that are `duration` ticks apart, the earlier ones first."""
    if not ticks.size:
        return ticks, ticks
    before = np.minimum(np.searchsorted(ticks, ticks - duration), ticks.size - 1)
    now = np.flatnonzero(ticks[before] == ticks - duration)
    return before[now], now


def _twice_turned(
    ticks: IntArray, yaw_rate: FloatArray, before: IntArray, now: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return J of `catalog.course`, twice the integral of the yaw rate, between pairs of rows.

    Also returns a mask of pairs without a missing yaw rate or tick between them.
    """
    missing = np.isnan(yaw_rate)
    counts = np.where(missing, 0.0, yaw_rate).astype(np.int64)
    total, gaps = np.cumsum(counts), np.cumsum(missing)
    turned = 2 * (total[now] - total[before]) - counts[now] + counts[before]
    is_gapless = ticks[now] - ticks[before] == now - before
    return turned, is_gapless & (gaps[now] == gaps[before]) & ~missing[before]


def _sideslip_change(
    units: CourseUnits, course: IntArray, turned: IntArray, by_delay: IntArray
) -> tuple[IntArray, BoolArray]:
    """Return the changes of the side-slip angle in counts of the label, and the plausible ones."""
    change = units.turn * course - 2 * HALF_TURN * turned + by_delay
    full_turn = 2 * HALF_TURN * units.turn
    change -= full_turn * _divide_rounded(change, full_turn)
    return _divide_rounded(change, units.divisor), np.abs(change) <= units.largest


def _divide_rounded(number: IntArray, divisor: int) -> IntArray:
    quotient: IntArray = (2 * np.abs(number) + divisor) // (2 * divisor)
    return np.sign(number) * quotient


# Statement of a feature set from `jobs/gram.sql`.

LOGS = "read_parquet(getvariable('log_files'), union_by_name => true, hive_partitioning => false)"

_SEPARATOR = ",\n            "

MAX_COLUMNS = 63
"""Maximum number of columns of a statement: bits of a BIGINT without the sign."""


def has_statement(catalog: Catalog, feature_set: str) -> bool:
    """Return True if SQL can compute a feature set; otherwise only the kernel can."""
    resolved = catalog.feature_set(feature_set)
    columns = rows_behind(catalog.definitions(feature_set)).values()
    slopes = any(isinstance(row.made, Slope) for row in columns)
    divided = resolved.change_ticks or resolved.block_ticks
    return not (divided or slopes) and len(resolved.columns) <= MAX_COLUMNS


def gram_statement(
    catalog: Catalog,
    feature_set: str = PLAIN,
    *,
    complete: bool = False,
    absent: Sequence[str] = (),
) -> str:
    """Return the statement that computes the Gram rows of a feature set.

    `complete` states that each column is in all rows of a file or in none; `absent` are newer
    columns that no file contains. Raises `QuestionError` for an unknown feature set, and for one
    that only the kernel computes.
    """
    signals = catalog.signals
    resolved = catalog.feature_set(feature_set)
    if not has_statement(catalog, feature_set):
        raise QuestionError(
            f"SQL cannot compute the Gram rows of {feature_set}: only the kernel has "
            "changes of the course, blocks of time, slopes and sets of many columns. Its columns: "
            "fleet-slip features --sql"
        )
    names = resolved.columns
    windows = catalog.definitions(feature_set)
    used = catalog.rows(resolved.features)
    logs = with_absent(signals, LOGS, absent)
    rows = with_columns(logs, used, windows)
    needs_64_bits = windows or any(feature.bits > COUNT_BITS for feature in used.values())
    kind = "BIGINT" if needs_64_bits else "INTEGER"
    pairs = ((a, b) for i, a in enumerate(names) for b in names[: i + 1])
    return read_sql("jobs", "gram.sql").format(
        drive_columns=", ".join(
            signals.null_sql(name) if name in absent else name for name in signals.drive
        ),
        qualified_drive_columns=", ".join(f"drive.{name}" for name in signals.drive),
        absent="0" if complete else _absent_mask(names),
        clipped="sum(clipped)::BIGINT" if used or windows else "0",
        sums=_SEPARATOR.join(f"sum({name})" for name in names),
        products=_SEPARATOR.join(f"sum({a}::{kind} * {b}::{kind})" for a, b in pairs),
        counts=rows,
        # Not grouped by a constant: DuckDB would hash a dictionary row by row.
        group="drive_id" if complete else "drive_id, absent",
        names=", ".join(f"'{name}'" for name in names),
    )


def _absent_mask(names: Sequence[str]) -> str:
    """Return SQL of a bit mask of the columns that a row lacks."""
    kind = "INTEGER" if len(names) < 32 else "BIGINT"
    return " + ".join(f"({name} IS NULL)::{kind} * {1 << i}" for i, name in enumerate(names))


FILES_PER_QUERY = 16
"""A query reads several files, since planning 77 aggregates takes 20 ms."""


def aggregate(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str = PLAIN,
    delays: CourseDelays = None,
) -> pa.Table:
    """Return the Gram rows of log files, in the schema of `grams`, sorted by file and drive."""
    in_time = warehouse.catalog.feature_set(feature_set).in_time
    empty = warehouse.computed_schema(in_time=in_time).empty_table()
    rows = compute_grams(warehouse, files, no_progress, feature_set, delays=delays)
    return pa.concat_tables([empty, *rows])


def compute_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    progress: Progress = no_progress,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
    delays: CourseDelays = None,
) -> Iterator[pa.Table]:
    """Yield the Gram rows of log files in the order of the files, in the schema of `grams`.

    Runs on all cores of this process, or in an executor as tasks of several files and one thread.
    """
    if not files:
        return
    resolved = warehouse.catalog.feature_set(feature_set)
    uses_kernel = bool(resolved.windows or resolved.block_ticks)
    # The kernel runs on one thread, DuckDB on several.
    is_local = uses_kernel and not executor
    local = LocalThreads(cpu_count() or 1) if is_local else nullcontext(executor)
    with local as workers:
        size = ceil(len(files) / in_flight(executor)) if executor else FILES_PER_QUERY
        step = 1 if uses_kernel else min(FILES_PER_QUERY, size)
        groups = [files[first : first + step] for first in range(0, len(files), step)]
        threads = 1 if executor else None
        compute = partial(by_sql, threads=threads)
        if uses_kernel:
            compute = partial(by_kernel, delays=delays)
        task = partial(compute, warehouse, feature_set=feature_set)
        total = sum(file.rows for file in files)
        early: dict[str, pa.Table] = {}  # by the first file of a group
        pending = deque(group[0].path for group in groups)
        for group, rows in run_tasks(workers, task, groups, _describe_task):
            early[group[0].path] = rows
            progress(sum(file.rows for file in group), total)
            while pending and pending[0] in early:
                yield early.pop(pending.popleft())


def _describe_task(group: Sequence[TableFile]) -> str:
    return f"the Gram rows of {pluralize(len(group), 'log file')} from {group[0].path}"


def by_sql(
    warehouse: Warehouse, files: Sequence[TableFile], feature_set: str, threads: int | None = None
) -> pa.Table:
    """Return the Gram rows of log files as `jobs/gram.sql` defines them."""
    catalog = warehouse.catalog
    paths = {warehouse.logs.uri(file.path): file.path for file in files}
    # By the statistics of the Delta log each signal is in all rows of a file or in none.
    complete = feature_set == PLAIN and all(
        file.null_counts.get(signal, file.rows) in (0, file.rows)
        for file in files
        for signal in catalog.signals.gram_signals
    )
    absent = absent_columns(files, catalog.signals.stored_columns)
    statement = gram_statement(catalog, feature_set, complete=complete, absent=absent)
    parameters = {"feature_set": catalog.identity(feature_set)}
    activity = f"the Gram query over {pluralize(len(files), 'log file')} in {warehouse.logs.folder}"
    with (
        open_database(reading=warehouse.logs.folder, threads=threads) as database,
        reading_files(database, activity),
    ):
        database.execute("SET VARIABLE log_files = $files", {"files": list(paths)})
        rows = database.sql(statement, params=parameters).to_arrow_table()
    relative = pa.array([paths[path] for path in rows["file"].to_pylist()], pa.string())
    return rows.set_column(rows.schema.get_field_index("file"), "file", relative).cast(
        warehouse.computed_schema(in_time=False)
    )
