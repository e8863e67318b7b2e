"""The files of a table as the Delta log has them, and what one commit does to them."""

import json
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Any

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.transaction import AddAction, RemoveAction

from fleet_slip.delta.encoding import Encoded
from fleet_slip.errors import StorageError

_DATA_FILE = re.compile(r"[\w.=-][\w.=/-]*\.parquet", re.ASCII)
"""Path of a data file below its table: relative, and without characters that could be a pattern."""

_NULLS = "null_count."
"""Before a column's name: how many nulls a file has in it. Null, if it has no such column."""


@dataclass(frozen=True)
class TableFile:
    """An active file of a table, as the Delta log has it, and the first and last of its days."""

    path: str
    rows: int
    size_bytes: int
    null_counts: Mapping[str, int]
    day: date | None = None
    days: tuple[date, date] | None = None


def absent_columns(files: Iterable[TableFile], names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that none of the files has: they came to the table later."""
    absent = dict.fromkeys(names)
    for file in files:
        if not absent:
            break
        for name in [name for name in absent if name in file.null_counts]:
            del absent[name]
    return tuple(absent)


def read_actions(delta: DeltaTable | None) -> pa.Table:
    """Return what the log says of each active file, a row a file; none without a table."""
    if delta is None:
        return pa.Table.from_pylist([])
    # pa.table() would import pandas, which takes half a second.
    stream = delta.get_add_actions(flatten=True)
    return pa.RecordBatchReader.from_stream(stream).read_all().combine_chunks()


def active_files(actions: pa.Table, where: object) -> tuple[TableFile, ...]:
    """Return the active files, by path. Raises `StorageError` if the log names one wrongly."""
    files = sorted(_table_files(actions), key=lambda file: file.path)
    for file in files:
        _require_sound(file, where)
    return tuple(files)


def have_same_columns(actions: pa.Table, names: Iterable[str]) -> bool:
    """Whether each of the columns is in all active files or in none."""
    counts = [actions[f"{_NULLS}{n}"] for n in names if f"{_NULLS}{n}" in actions.column_names]
    return all(column.null_count in (0, len(column)) for column in counts)


def _require_sound(file: TableFile, where: object) -> None:
    parts = file.path.split("/")
    if not _DATA_FILE.fullmatch(file.path) or ".." in parts or "." in parts:
        raise StorageError(
            f"{where}: the Delta log names the file {file.path[:200]!r}, which is "
            "not one of this table. Restore the log from a backup."
        )
    if file.rows is None or file.rows < 0 or file.size_bytes is None or file.size_bytes < 0:
        raise StorageError(
            f"{where}: the Delta log does not say how large {file.path} is. "
            "Another program wrote it, or it was damaged: restore the log from a backup."
        )


class _NullCounts(Mapping[str, int]):
    """Null counts of a file, looked up when asked for: of 100,000 files few jobs need many."""

    def __init__(self, columns: Mapping[str, pa.ChunkedArray], row: int) -> None:
        self._columns = columns
        self._row = row

    def __getitem__(self, name: str) -> int:
        count: int | None = self._columns[name][self._row].as_py()
        if count is None:
            raise KeyError(name)
        return count

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._columns if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __reduce__(self) -> tuple[type[dict[str, int]], tuple[dict[str, int]]]:
        """Send another process what is of this file only."""
        return dict, (dict(self),)


def _table_files(actions: pa.Table) -> Iterator[TableFile]:
    nulls = {
        name.removeprefix(_NULLS): actions[name]
        for name in actions.column_names
        if name.startswith(_NULLS)
    }
    unknown = [None] * actions.num_rows
    columns = (
        actions[name].to_pylist() if name in actions.column_names else unknown
        for name in ("path", "num_records", "size_bytes", "partition.day", "min.day", "max.day")
    )
    for row, (path, rows, size_bytes, day, first, last) in enumerate(zip(*columns, strict=True)):
        days = (first, last) if first and last else None
        yield TableFile(path, rows, size_bytes, _NullCounts(nulls, row), day, days)


@dataclass(frozen=True)
class Unit:
    """A piece of work that lands exactly once: its name, and a number that its content determines.

    A Delta transaction identifier: of two processes that land it at once, one is in conflict.
    """

    name: str
    version: int


@dataclass(frozen=True)
class Change:
    """What a commit does; files added and removed stay. `data_change` is false if rows move."""

    add: Sequence[AddAction] = ()
    remove: Sequence[TableFile] = ()
    units: Sequence[Unit] = ()
    note: Mapping[str, Any] = field(default_factory=dict)
    data_change: bool = True

    def actions(self) -> list[AddAction | RemoveAction]:
        """Return what the commit says to the Delta log, as of now."""
        both = {action.path for action in self.add} & {file.path for file in self.remove}
        return [
            *(action for action in self.add if action.path not in both),
            *(
                RemoveAction(
                    path=file.path,
                    data_change=self.data_change,
                    deletion_timestamp=_now_ms(),
                    size=file.size_bytes,
                    partition_values=_partition(file.day),
                )
                for file in self.remove
                if file.path not in both
            ),
        ]


def rows_in(action: AddAction) -> int:
    """Return the number of rows of a file that an action adds."""
    return int(json.loads(action.stats)["numRecords"])


def columns_in(action: AddAction) -> frozenset[str]:
    """Return the columns of a file that an action adds."""
    return frozenset(json.loads(action.stats)["nullCount"])


def addition(path: str, encoded: Encoded, day: date | None) -> AddAction:
    """Return the action that adds a file to a table."""
    return AddAction(
        path=path,
        size=len(encoded.content),
        partition_values=_partition(day),
        modification_time=_now_ms(),
        data_change=True,
        stats=encoded.statistics,
    )


def _partition(day: date | None) -> dict[str, str | None]:
    return {"day": day.isoformat()} if day else {}


def _now_ms() -> int:
    return int(time.time() * 1000)
