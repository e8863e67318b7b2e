"""Computes the Gram rows of log files: plain sets by `jobs/gram.sql`, windows by the kernel."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from math import ceil
from os import cpu_count
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.catalog import Catalog, FeatureSet
from fleet_slip.catalog.course import COURSE_LATE, course_units
from fleet_slip.catalog.definitions import COUNT_BITS, Slope, rows_behind
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.block_program import BLOCK_ROWS, ColumnPlan
from fleet_slip.columns.column_sql import with_absent, with_columns
from fleet_slip.columns.drive_columns import DriveCounts, Workspace
from fleet_slip.compute.tasks import LocalThreads, in_flight, run_tasks
from fleet_slip.errors import DataError, QuestionError, StorageError
from fleet_slip.grams.course_changes import Fixes
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import TableFile, absent_columns
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.warehouse import Warehouse

# The rows of drives, one drive at a time in the order of time: from log files, or from a query.


def read_drives(warehouse: Warehouse, file: TableFile, plan: ColumnPlan) -> Iterator[DriveCounts]:
    """Yield a log file's drives in the order of time, their metadata as facts.

    As in SQL, none without a row of tick 0.
    """
    drive_columns = tuple(warehouse.catalog.signals.drive)
    present = warehouse.logs.read_metadata(file.path).schema.to_arrow_schema().names
    wanted = [name for name in (*drive_columns, "tick", *plan.signals) if name in present]
    rows = warehouse.logs.read(file.path, wanted)
    for one in rows_by_drive(rows):
        ticks = one["tick"].to_numpy()
        if (ticks[1:] < ticks[:-1]).any():
            order = np.argsort(ticks, kind="stable")
            one, ticks = one.take(order), ticks[order]  # noqa: PLW2901
        at = int(np.searchsorted(ticks, 0))
        if at < len(ticks) and ticks[at] == 0:
            metadata = {
                name: one[name][at].as_py() if name in wanted else None for name in drive_columns
            }
            yield counts_of(one, plan, metadata)


def counts_of(
    rows: pa.Table,
    plan: ColumnPlan,
    facts: Mapping[str, Any] | None = None,
    numbers: Mapping[str, int] | None = None,
) -> DriveCounts:
    """Return a drive's rows, in the order of time, as what a plan is computed from.

    Facts are by default the first row's; `numbers` are what the car's drives determined.
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
    known = facts if facts is not None else {name: rows[name][0].as_py() for name in plan.facts}
    return DriveCounts(rows["tick"].to_numpy(), counts, present, known, numbers or {})


def drives_of_stream(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows of each drive from batches that are sorted by drive."""
    waiting: list[pa.Table] = []
    for batch in batches:
        for part in rows_by_drive(pa.Table.from_batches([batch])):
            if waiting and waiting[0]["drive_id"][0] != part["drive_id"][0]:
                yield pa.concat_tables(waiting)
                waiting = []
            waiting.append(part)
    if waiting:
        yield pa.concat_tables(waiting)


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


@dataclass(frozen=True)
class DriveBlocks:
    """How the rows of a drive are divided: by blocks of time, or by what they change over.

    Of several `times` that columns change over, each has all rows.
    """

    block_ticks: int | None = None
    times: tuple[str, ...] = ()

    @classmethod
    def of_set(cls, one: FeatureSet) -> "DriveBlocks":
        """Return what divides the rows of a feature set."""
        times = tuple(f"{time_s:f} s" for time_s in one.change_s)
        return cls(one.block_ticks, times if len(times) > 1 else ())

    def numbers(self, ticks: NDArray[Any]) -> IntArray:
        """Return the block of each row, shape (rows,); 0 where there are none."""
        if not self.block_ticks:
            return np.zeros(len(ticks), dtype=np.int64)
        return ticks.astype(np.int64) // self.block_ticks

    def name(self, number: int) -> str | None:
        """Return the name of a part, which sorts as numbers do; None where there is one."""
        if self.block_ticks:
            return f"block {number + 1:04}"
        return self.times[number] if self.times else None


# Fills in `jobs/gram.sql` for a feature set.

LOGS = "read_parquet(getvariable('log_files'), union_by_name => true, hive_partitioning => false)"

_SEPARATOR = ",\n            "

BITS = 63
"""Bits of a BIGINT that are no sign."""

MAX_SUMS = 8_000
"""Sums of a grouping: DuckDB 2.0.0 ends with SIGFPE where those of a group, 24 bytes each, are
longer than its block of 262,144 bytes."""


def has_statement(catalog: Catalog, feature_set: str) -> bool:
    """Return True if SQL can compute a feature set; otherwise only the kernel can."""
    resolved = catalog.feature_set(feature_set)
    k, windows = len(resolved.columns), catalog.definitions(feature_set)
    slopes = any(isinstance(row.made, Slope) for row in rows_behind(windows).values())
    divided = resolved.change_ticks or resolved.block_ticks
    return not (divided or slopes) and k + k * (k + 1) // 2 <= MAX_SUMS


def gram_statement(
    catalog: Catalog, feature_set: str = PLAIN, *, whole: bool = False, absent: Sequence[str] = ()
) -> str:
    """Return the statement that computes the Gram rows of a feature set.

    `whole`: no file has a column in only some rows; `absent` are later columns, which none has.
    Raises `QuestionError` for an unknown set, and for one that the kernel alone computes.
    """
    signals = catalog.signals
    resolved = catalog.feature_set(feature_set)
    if not has_statement(catalog, feature_set):
        raise QuestionError(
            f"SQL cannot compute the Gram rows of {feature_set}: only the compiled kernel has "
            "changes of the course, blocks of time, slopes and sets of many columns. Its columns: "
            "fleet-slip features --sql"
        )
    names = resolved.columns
    windows = catalog.definitions(feature_set)
    used = catalog.rows(resolved.features)
    logs = with_absent(signals, LOGS, absent)
    rows = with_columns(logs, used, windows)
    wide = windows or any(feature.bits > COUNT_BITS for feature in used.values())
    kind = "BIGINT" if wide else "INTEGER"
    sums = [f"sum({name})" for name in names]
    products = [
        f"sum({a}::{kind} * {b}::{kind})" for i, a in enumerate(names) for b in names[: i + 1]
    ]
    return read_sql("jobs", "gram.sql").format(
        drive_columns=", ".join(
            signals.null_sql(name) if name in absent else name for name in signals.drive
        ),
        qualified_drive_columns=", ".join(f"drive.{name}" for name in signals.drive),
        absent="0" if whole else _absent(names),
        clipped="sum(clipped)::BIGINT" if used or windows else "0",
        sums=_SEPARATOR.join(sums),
        products=_SEPARATOR.join(products),
        counts=rows,
        # No constant, lest DuckDB hash a dictionary row by row.
        group="drive_id" if whole else "drive_id, absent",
        names=", ".join(f"'{name}'" for name in names),
    )


def _absent(names: Sequence[str]) -> str:
    """Return SQL of a number with a bit for each column that a row lacks; of many, a list."""
    if len(names) < BITS:
        kind = "INTEGER" if len(names) < 32 else "BIGINT"
        return " + ".join(f"({name} IS NULL)::{kind} * {1 << i}" for i, name in enumerate(names))
    parts = [_absent(names[first : first + BITS - 1]) for first in range(0, len(names), BITS - 1)]
    # The last columns come first, so that lists sort as the one large number would.
    return f"[{', '.join(f'({part})::BIGINT' for part in reversed(parts))}]"


FILES_PER_QUERY = 16
"""Planning 77 aggregates costs 20 ms, so that one query takes many files."""

Late = Mapping[str, int] | None
"""By how many parts of a tick the course of each car is late; in time where it says nothing."""


def aggregate(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str = PLAIN,
    late: Late = None,
) -> pa.Table:
    """Return the Gram rows of log files, in the schema of `grams`, sorted by file and drive."""
    in_time = warehouse.catalog.feature_set(feature_set).in_time
    empty = warehouse.computed_schema(in_time=in_time).empty_table()
    rows = compute_grams(warehouse, files, no_progress, feature_set, late=late)
    return pa.concat_tables([empty, *rows])


def compute_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    progress: Progress = no_progress,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
    late: Late = None,
) -> Iterator[pa.Table]:
    """Yield the Gram rows of log files, one file after the other, in the schema of `grams`.

    `late` is the delay of each car's course in parts of a tick. The work is done here, on all
    cores, or by an executor as tasks of some files and one thread each.
    """
    if not files:
        return
    resolved = warehouse.catalog.feature_set(feature_set)
    wide = bool(resolved.windows or resolved.block_ticks)
    if executor is None and not wide:
        total = sum(file.rows for file in files)
        with open_database(reading=warehouse.logs.folder) as database:
            for group in _groups(files, FILES_PER_QUERY):
                yield _query(database, warehouse, group, feature_set)
                progress(sum(file.rows for file in group), total)
        return
    with nullcontext(executor) if executor else LocalThreads(cpu_count() or 1) as workers:
        many = 1 if wide else ceil(len(files) / in_flight(workers))
        groups = _groups(files, min(FILES_PER_QUERY, max(1, many)))
        way = partial(wide_grams, late=late) if wide else partial(by_sql, threads=1)
        task = partial(way, warehouse, feature_set=feature_set)
        yield from _by_tasks(workers, task, groups, progress)


def _by_tasks(
    executor: Executor,
    task: Callable[[Sequence[TableFile]], pa.Table],
    groups: list[Sequence[TableFile]],
    progress: Progress,
) -> Iterator[pa.Table]:
    """Yield the results of tasks in the order of their files; those that are early wait."""
    total = sum(file.rows for group in groups for file in group)

    def name_of(group: Sequence[TableFile]) -> str:
        return f"the Gram rows of {pluralize(len(group), 'log file')} from {group[0].path}"

    done: dict[str, pa.Table] = {}
    following = iter(groups)
    awaited = next(following, None)
    for group, rows in run_tasks(executor, task, groups, name_of):
        done[group[0].path] = rows
        progress(sum(file.rows for file in group), total)
        while awaited is not None and awaited[0].path in done:
            yield done.pop(awaited[0].path)
            awaited = next(following, None)


def _groups(files: Sequence[TableFile], step: int) -> list[Sequence[TableFile]]:
    return [files[first : first + step] for first in range(0, len(files), step)]


def by_sql(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
    threads: int | None = None,
) -> pa.Table:
    """Return the Gram rows of log files as `jobs/gram.sql` defines them."""
    with open_database(reading=warehouse.logs.folder, threads=threads) as database:
        return _query(database, warehouse, files, feature_set)


def _query(
    database: duckdb.DuckDBPyConnection,
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
) -> pa.Table:
    catalog = warehouse.catalog
    paths = {warehouse.logs.uri(file.path): file.path for file in files}
    # Whether each signal is in all rows of a file or in none, by the Delta log's statistics.
    whole = feature_set == PLAIN and all(
        file.null_counts.get(signal, file.rows) in (0, file.rows)
        for file in files
        for signal in catalog.signals.gram_signals
    )
    absent = absent_columns(files, catalog.signals.stored_columns)
    statement = gram_statement(catalog, feature_set, whole=whole, absent=absent)
    identity = catalog.identity(feature_set)
    doing = f"the Gram query over {pluralize(len(files), 'log file')} in {warehouse.logs.folder}"
    with reading_files(database, doing):
        database.execute("SET VARIABLE log_files = $files", {"files": list(paths)})
        rows = database.sql(statement, params={"feature_set": identity}).to_arrow_table()
    relative = pa.array([paths[path] for path in rows["file"].to_pylist()], pa.string())
    return rows.set_column(rows.schema.get_field_index("file"), "file", relative).cast(
        warehouse.computed_schema(in_time=False)
    )


# Gram rows of any feature set, from the columns of log files: what SQL says, faster.
#
# Drives are gone through once, in time. Columns are integers below 2^19 in binary64, whose products
# and block sums stay below 2^53: exact in any order. Sums of blocks have 64 bits.

_INT64 = 2**63


def wide_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
    late: Mapping[str, int] | None = None,
) -> pa.Table:
    """Return the Gram rows of log files for a feature set, sorted as by `jobs/gram.sql`.

    `late` is the course's delay of cars, in parts of a tick. Raises `DataError` for a drive that
    cannot be looked back on, `StorageError` for sums of more than 64 bits.
    """
    catalog = warehouse.catalog
    resolved, model = catalog.feature_set(feature_set), catalog.first_stage_model(feature_set)
    workspaces: dict[str | None, Workspace] = {
        None: Workspace(ColumnPlan.of_set(catalog, feature_set))
    }
    plan = workspaces[None].plan
    identity = catalog.identity(feature_set)
    schema = warehouse.computed_schema(in_time=resolved.in_time)
    rows: list[dict[str, Any]] = []
    # Files are shared out among threads; a BLAS with threads of its own would be in their way.
    with threadpool_limits(1, user_api="blas"):
        for file in sorted(files, key=lambda file: file.path):
            drives = read_drives(warehouse, file, plan)
            for drive in sorted(drives, key=lambda drive: str(drive.facts["drive_id"])):
                fold = model.fold_of(str(drive.facts["drive_id"])) if model else None
                if fold not in workspaces:
                    workspaces[fold] = Workspace(ColumnPlan.of_set(catalog, feature_set, fold))
                delay = (late or {}).get(drive.facts["vehicle_id"])
                metadata = {**drive.facts, "feature_set": identity, COURSE_LATE: delay}
                metadata |= {"file": file.path, "day": file.day}
                rows += _rows_of_drive(catalog.signals, workspaces[fold], resolved, drive, metadata)
    return pa.Table.from_pylist(rows, schema=schema)


def _rows_of_drive(
    signals: SignalCatalog,
    workspace: Workspace,
    feature_set: FeatureSet,
    drive: DriveCounts,
    metadata: Mapping[str, Any],
) -> Iterator[dict[str, Any]]:
    parts = DriveBlocks.of_set(feature_set)
    try:
        if feature_set.change_ticks:
            late = (metadata[COURSE_LATE] or 0) if feature_set.in_time else 0
            sums = change_sums(signals, workspace, drive, feature_set.change_ticks, late)
        else:
            sums = drive_sums(workspace, parts, drive)
    except DataError as error:
        raise DataError(f"{metadata['file']}: drive {metadata['drive_id']}: {error}") from None
    return gram_rows(sums, feature_set.columns, parts, metadata)


def gram_rows(
    found: "Mapping[Kind, BlockSums]",
    columns: Sequence[str],
    parts: DriveBlocks,
    known: Mapping[str, Any],
) -> Iterator[dict[str, Any]]:
    """Yield the Gram rows of a drive's sums with what is known of it, sorted as by SQL."""
    for absent, part in sorted(found):
        sums = found[absent, part]
        names = [name for i, name in enumerate(columns) if not absent >> i & 1]
        yield {
            **known,
            "part": parts.name(part),
            "signals": ",".join(names),
            "n": sums.n,
            "clipped": sums.clipped,
            "sums": sums.sums,
            "products": sums.products[np.tril_indices(len(names))],
        }


@dataclass
class BlockSums:
    """Sums of the rows of a drive, or of a part of it, that have the same columns."""

    size: int
    n: int = 0
    clipped: int = 0
    sums: NDArray[np.int64] = field(init=False)
    products: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.sums = np.zeros(self.size, dtype=np.int64)
        self.products = np.zeros((self.size, self.size), dtype=np.int64)

    def add(self, block: FloatArray, clipped: FloatArray) -> None:
        """Add complete rows, shape (columns, rows), and what was clipped in each.

        At most `BLOCK_ROWS`: then all sums are exact. Columns of zeros, as those of a gate that is
        shut, are passed over.
        """
        self.n += block.shape[1]
        self.clipped += int(clipped.sum())
        self.sums += block.sum(axis=1).astype(np.int64)
        some = block.any(axis=1)
        block = block if some.all() else block[some]
        self.products[np.ix_(some, some)] += (block @ block.T).astype(np.int64)


Kind = tuple[int, int]
"""Which columns rows lack, a number of one bit each, and which part of the drive they are."""


def drive_sums(
    workspace: Workspace, parts: DriveBlocks, counts: DriveCounts
) -> dict[Kind, BlockSums]:
    """Return the sums of a drive's rows, by columns missing and part; raises as `wide_grams`."""
    plan, total = workspace.plan, len(counts.ticks)
    _require_64_bits(total, max(plan.limits))
    found: dict[Kind, BlockSums] = {}
    for rows, block, clipped in workspace.blocks(counts):
        _add_by_kind(found, block, clipped, parts.numbers(counts.ticks[rows]))
    return found


def change_sums(
    signals: SignalCatalog,
    workspace: Workspace,
    counts: DriveCounts,
    times: Sequence[int],
    late: int = 0,
) -> dict[Kind, BlockSums]:
    """Return the sums of a drive's changes, by columns missing and time; the course is `late`."""
    _require_64_bits(len(counts.ticks), 2 * max(workspace.plan.limits))
    fixes = Fixes(course_units(signals), workspace, counts, late)
    found: dict[Kind, BlockSums] = {}
    for part, apart in enumerate(times):
        rows, columns, clipped = fixes.changes(apart)
        _add_by_kind(found, columns, clipped, np.full(len(rows), part))
    return found


def _require_64_bits(rows: int, largest: int) -> None:
    if rows * largest**2 >= _INT64:
        raise StorageError(f"the drive has {rows:,} rows: too many for 64-bit sums.")


def _add_by_kind(
    found: dict[Kind, BlockSums], columns: FloatArray, clipped: FloatArray, numbers: IntArray
) -> None:
    """Add rows of several kinds, given the part of each, so many at once as are exact."""
    for (absent, part), rows in _kinds(columns, numbers):
        has = [i for i in range(len(columns)) if not absent >> i & 1]
        sums = found.setdefault((absent, part), BlockSums(len(has)))
        for first in range(0, len(rows), BLOCK_ROWS):
            some = rows[first : first + BLOCK_ROWS]
            block = columns if len(some) == len(clipped) else columns.take(some, axis=1)
            sums.add(block if len(has) == len(block) else block[has], clipped[some])


def _kinds(block: FloatArray, numbers: IntArray) -> Iterator[tuple[Kind, NDArray[np.int64]]]:
    lacks = np.isnan(block)
    some = np.flatnonzero(lacks.any(axis=0))  # few, as a rule: patterns take sorting
    pattern_of_row, absents = np.zeros(block.shape[1], dtype=np.int64), [0]
    if len(some):
        packed = np.packbits(lacks[:, some], axis=0, bitorder="little")
        patterns, of_some = np.unique(packed, axis=1, return_inverse=True)
        absents += [int.from_bytes(one.tobytes(), "little") for one in patterns.T]
        pattern_of_row[some] = 1 + of_some.reshape(-1)
    kind_of_row = numbers * len(absents) + pattern_of_row
    for kind in np.unique(kind_of_row).tolist():
        number, pattern = divmod(kind, len(absents))
        yield (absents[pattern], number), np.flatnonzero(kind_of_row == kind)
