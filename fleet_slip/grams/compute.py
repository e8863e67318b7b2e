"""Gram rows of log files: plain feature sets by `jobs/gram.sql`, windows by the kernel."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from functools import partial
from math import ceil
from os import cpu_count

import pyarrow as pa

from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import COUNT_BITS, Slope, rows_behind
from fleet_slip.catalog.features import PLAIN
from fleet_slip.columns.column_sql import with_absent, with_columns
from fleet_slip.compute.tasks import LocalThreads, in_flight, run_tasks
from fleet_slip.errors import QuestionError
from fleet_slip.grams.drive_sums import CourseDelays, wide_grams
from fleet_slip.resources import read_sql
from fleet_slip.storage.table import TableFile, absent_columns
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.warehouse import Warehouse

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
        absent="0" if complete else _absent_mask(names),
        clipped="sum(clipped)::BIGINT" if used or windows else "0",
        sums=_SEPARATOR.join(sums),
        products=_SEPARATOR.join(products),
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
    wide = bool(resolved.windows or resolved.block_ticks)
    # DuckDB has threads of its own; the kernel has one.
    local = LocalThreads(cpu_count() or 1) if wide and not executor else nullcontext(executor)
    with local as workers:
        size = ceil(len(files) / in_flight(executor)) if executor else FILES_PER_QUERY
        groups = _groups(files, 1 if wide else min(FILES_PER_QUERY, size))
        threads = 1 if executor else None
        compute = partial(wide_grams, delays=delays) if wide else partial(by_sql, threads=threads)
        task = partial(compute, warehouse, feature_set=feature_set)
        yield from _run_in_order(workers, task, groups, progress)


def _run_in_order(
    executor: Executor | None,
    task: Callable[[Sequence[TableFile]], pa.Table],
    groups: list[Sequence[TableFile]],
    progress: Progress,
) -> Iterator[pa.Table]:
    """Yield the results of tasks in the order of their files."""
    total = sum(file.rows for group in groups for file in group)

    def name_of(group: Sequence[TableFile]) -> str:
        return f"the Gram rows of {pluralize(len(group), 'log file')} from {group[0].path}"

    early: dict[str, pa.Table] = {}
    pending = deque(group[0].path for group in groups)
    for group, rows in run_tasks(executor, task, groups, name_of):
        early[group[0].path] = rows
        progress(sum(file.rows for file in group), total)
        while pending and pending[0] in early:
            yield early.pop(pending.popleft())


def _groups(files: Sequence[TableFile], step: int) -> list[Sequence[TableFile]]:
    return [files[first : first + step] for first in range(0, len(files), step)]


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
