"""Computes the Gram rows of log files: plain sets by `jobs/gram.sql`, windows by the kernel."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from functools import partial
from math import ceil
from os import cpu_count

import duckdb
import pyarrow as pa

from fleet_slip.catalogue.course_change import COURSE_LATE
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.compute.tasks import LocalThreads, in_flight, run_tasks
from fleet_slip.delta import TableFile, absent_columns
from fleet_slip.grams.rows.statement import gram_statement
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.database import open_database, reading_files
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

FILES_PER_QUERY = 16
"""Planning 77 aggregates costs 20 ms, so that one query takes many files."""

Late = Mapping[str, int] | None
"""By how many parts of a tick the course of each car is late; in time where it says nothing."""

LAGGED_FILES_PER_QUERY = 2
"""Rows are sorted to find the one before, which takes memory for all rows of a query."""


def aggregate(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    progress: Progress = no_progress,
    threads: int | None = None,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
    late: Late = None,
) -> pa.Table:
    """Return the Gram rows of log files, in the schema of `grams`, sorted by file and drive."""
    in_time = features().feature_set(feature_set).in_time
    empty = warehouse.computed_schema(in_time=in_time).empty_table()
    return pa.concat_tables(
        [empty, *compute_grams(warehouse, files, progress, threads, feature_set, executor, late)]
    )


def compute_grams(
    warehouse: Warehouse,
    files: Sequence[TableFile],
    progress: Progress = no_progress,
    threads: int | None = None,
    feature_set: str = PLAIN,
    executor: Executor | None = None,
    late: Late = None,
) -> Iterator[pa.Table]:
    """Yield the Gram rows of log files, one file after the other, in the schema of `grams`.

    `late` is the delay of each car's course in parts of a tick. The work is done here, on all cores
    or `threads`, or by an executor as tasks of some files and one thread each.
    """
    if features().feature_set(feature_set).windows:
        from fleet_slip.grams.rows.windowed_grams import wide_grams  # noqa: PLC0415 - the compiler takes a while

        own = LocalThreads(threads or cpu_count() or 1) if executor is None else None
        with own or nullcontext():
            task = partial(wide_grams, warehouse, feature_set=feature_set, late=late)
            yield from _by_tasks(executor or own, task, _groups(files, 1), progress)
        return
    step = LAGGED_FILES_PER_QUERY if features().feature_set(feature_set).lagged else FILES_PER_QUERY
    if executor is not None:
        groups = _groups(files, min(step, max(1, ceil(len(files) / in_flight(executor)))))
        task = partial(_aggregate_group, warehouse, feature_set)
        yield from _by_tasks(executor, task, groups, progress)
        return
    total = sum(file.rows for file in files)
    with open_database(reading=warehouse.logs.folder, threads=threads) as database:
        for group in _groups(files, step):
            yield _query(database, warehouse, group, feature_set)
            progress(sum(file.rows for file in group), total)


def _by_tasks(
    executor: Executor | None,
    task: Callable[[Sequence[TableFile]], pa.Table],
    groups: list[Sequence[TableFile]],
    progress: Progress,
) -> Iterator[pa.Table]:
    """Yield the results of tasks in the order of their files; those that are early wait."""
    total = sum(file.rows for group in groups for file in group)
    done: dict[str, pa.Table] = {}
    following = iter(groups)
    awaited = next(following, None)
    for group, rows in run_tasks(executor, task, groups, _group_name):
        done[group[0].path] = rows
        progress(sum(file.rows for file in group), total)
        while awaited is not None and awaited[0].path in done:
            yield done.pop(awaited[0].path)
            awaited = next(following, None)


def _groups(files: Sequence[TableFile], step: int) -> list[Sequence[TableFile]]:
    return [files[first : first + step] for first in range(0, len(files), step)]


def _group_name(group: Sequence[TableFile]) -> str:
    return f"the Gram rows of {number_of(len(group), 'log file')} from {group[0].path}"


def _aggregate_group(
    warehouse: Warehouse, feature_set: str, files: Sequence[TableFile]
) -> pa.Table:
    with open_database(reading=warehouse.logs.folder, threads=1) as database:
        return _query(database, warehouse, files, feature_set)


def by_sql(
    warehouse: Warehouse, files: Sequence[TableFile], feature_set: str, late: Late = None
) -> pa.Table:
    """Return the Gram rows of log files as `jobs/gram.sql` defines them, of any feature set."""
    with open_database(reading=warehouse.logs.folder) as database:
        return _query(database, warehouse, files, feature_set, late)


def _query(
    database: duckdb.DuckDBPyConnection,
    warehouse: Warehouse,
    files: Sequence[TableFile],
    feature_set: str,
    late: Late = None,
) -> pa.Table:
    paths = {warehouse.logs.uri(file.path): file.path for file in files}
    # Whether each signal is in all rows of a file or in none, by the Delta log's statistics.
    whole = feature_set == PLAIN and all(
        file.null_counts.get(signal, file.rows) in (0, file.rows)
        for file in files
        for signal in warehouse.catalogue.gram_signals
    )
    absent = absent_columns(files, warehouse.catalogue.stored_columns)
    statement = gram_statement(warehouse.catalogue, feature_set, whole=whole, absent=absent)
    identity = features().identity(feature_set)
    doing = f"the Gram query over {number_of(len(files), 'log file')} in {warehouse.logs.folder}"
    with reading_files(database, doing):
        database.execute("SET VARIABLE log_files = $files", {"files": list(paths)})
        set_late(database, late)
        rows = database.sql(statement, params={"feature_set": identity}).to_arrow_table()
    relative = pa.array([paths[path] for path in rows["file"].to_pylist()], pa.string())
    in_time = features().feature_set(feature_set).in_time
    return rows.set_column(rows.schema.get_field_index("file"), "file", relative).cast(
        warehouse.computed_schema(in_time=in_time)
    )


def set_late(database: duckdb.DuckDBPyConnection, late: Late) -> None:
    """Tell the statements of a connection how late the course of each car is."""
    cars = sorted(late or {})
    database.execute(
        f"SET VARIABLE {COURSE_LATE} = map($cars::VARCHAR[], $late::INTEGER[])",
        {"cars": cars, "late": [(late or {})[car] for car in cars]},
    )
