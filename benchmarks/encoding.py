"""How log files should be laid out: bytes, writing, a bare sum and the Gram query.

    python -m benchmarks.encoding [--root DATA] [--campaign waterford] [--copies 2]
        [--only row-group]

Rows are those of the campaign, which is simulated into the data root first if it is not there (a
temporary one by default), copied under other names of drives. Each layout differs from
today's in one thing. All layouts are read in turn, in several rounds, and the best round counts;
the Gram rows of all layouts of a kind are compared. Times are of one thread and in CPU time, so
that other work on the machine disturbs them little.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.pipeline import SIGNALS, add_options, job_statement, prepare
from fleet_slip.delta.encoding import ROW_GROUP_ROWS, WRITE_BATCH_ROWS
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.rows.aggregation import FILES_PER_QUERY
from fleet_slip.warehouse.tables import Warehouse

ROUNDS = 3
FILE_ROWS = 2**19
DAY = "day=2024-05-01"


@dataclass(frozen=True)
class Layout:
    """How rows are laid out in files, and how many files a query takes."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    row_group_rows: int = ROW_GROUP_ROWS
    file_rows: int = FILE_ROWS
    order: Callable[[pa.Table], pa.Table] = lambda rows: rows
    files_per_query: int = FILES_PER_QUERY


@dataclass
class Measured:
    """The files of a layout, and the best CPU times in s."""

    layout: Layout
    files: list[str]
    size_bytes: int
    write_s: float
    bare_s: float = math.inf
    gram_s: float = math.inf


def _sorted(rows: pa.Table, first: str, second: str) -> pa.Table:
    keys = {
        "drive_id": rows["drive_id"].combine_chunks().indices.to_numpy(),
        "tick": rows["tick"].to_numpy(),
        "wheel_fl": rows["wheel_fl"].to_numpy(),
    }
    return rows.take(np.lexsort([keys[second], keys[first]]))


def interleaved(rows: pa.Table) -> pa.Table:
    """Sort by time, so that neighbouring rows are of different drives."""
    return _sorted(rows, "tick", "drive_id")


def by_speed(rows: pa.Table) -> pa.Table:
    """Sort by a signal within each drive."""
    return _sorted(rows, "drive_id", "wheel_fl")


def shuffled(rows: pa.Table) -> pa.Table:
    """Put rows into a random order."""
    return rows.take(np.random.default_rng(0).permutation(rows.num_rows))


def layouts(today: dict[str, Any]) -> dict[str, list[Layout]]:
    """Return the layouts to compare, by what they vary."""
    counts = list(today["column_encoding"])

    def encoded(encoding: str, compression: str) -> dict[str, Any]:
        columns = dict.fromkeys(counts, encoding)
        return {**today, "column_encoding": columns, "compression": compression}

    dictionary = {"use_dictionary": True, "compression": "none"}
    return {
        "encoding": [
            Layout("DELTA_BINARY_PACKED (today)", today),
            Layout("DELTA_BINARY_PACKED, lz4", encoded("DELTA_BINARY_PACKED", "lz4")),
            Layout("DELTA_BINARY_PACKED, zstd", encoded("DELTA_BINARY_PACKED", "zstd")),
            Layout("PLAIN", encoded("PLAIN", "none")),
            Layout("PLAIN, snappy", encoded("PLAIN", "snappy")),
            Layout("PLAIN, zstd", encoded("PLAIN", "zstd")),
            Layout("BYTE_STREAM_SPLIT, zstd", encoded("BYTE_STREAM_SPLIT", "zstd")),
            Layout("dictionaries", dictionary),
            Layout("dictionaries, zstd", {**dictionary, "compression": "zstd"}),
        ],
        "page": [
            Layout(f"pages of {size >> 10:,} KiB", {**today, "data_page_size": size})
            for size in (2**13, 2**16, 2**20, 2**23)
        ],
        "row-group": [
            Layout(f"row groups of {rows:,}", today, row_group_rows=rows)
            for rows in (2**13, 2**15, 2**16, 2**17, 2**18, 2**19)
        ],
        "file": [
            Layout(f"files of about {rows:,}", today, file_rows=rows)
            for rows in (2**16, 2**18, 2**20, 2**22)
        ],
        "order": [
            Layout("by drive and time (today)", today),
            Layout("by drive and wheel speed", today, order=by_speed),
            Layout("by time", today, order=interleaved),
            Layout("at random", today, order=shuffled),
        ],
        "batch": [
            Layout(f"{files} files a query", today, file_rows=2**17, files_per_query=files)
            for files in (1, 4, 16, 64)
        ],
    }


def source_rows(warehouse: Warehouse, copies: int) -> pa.Table:
    """Return the rows of the logs, copied under other names of drives, in order of drives."""
    usual = warehouse.logs.usual_schema.names  # what every file has, but for the day
    tables = [
        pq.read_table(path, partitioning=None, columns=[name for name in usual if name != "day"])
        for path in warehouse.logs.snapshot().paths
    ]
    rows = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    place = rows.schema.get_field_index("drive_id")
    drives = rows.column(place).chunk(0)
    parts = []
    for copy in range(copies):
        names = pa.array([f"{copy}-{name}" for name in drives.dictionary.to_pylist()])
        renamed = pa.DictionaryArray.from_arrays(drives.indices, names)
        parts.append(rows.set_column(place, "drive_id", renamed))
    every = pa.concat_tables(parts).unify_dictionaries()
    # As the jobs write them: columns without a null are declared so.
    fields = [field.with_nullable(every[field.name].null_count > 0) for field in every.schema]
    return every.cast(pa.schema(fields))


def drive_starts(rows: pa.Table) -> list[int]:
    """Return the number of the first row of each drive, and the number of rows."""
    return [*np.flatnonzero(rows["tick"].to_numpy() == 0).tolist(), rows.num_rows]


def slices(rows: pa.Table, file_rows: int) -> Iterator[pa.Table]:
    """Cut rows into files of whole drives, each about as long as asked for."""
    first = 0
    for _, end in zip(starts := drive_starts(rows), starts[1:], strict=False):
        if end - first >= file_rows or end == rows.num_rows:
            yield rows.slice(first, end - first)
            first = end


def write(layout: Layout, rows: pa.Table, folder: Path) -> Measured:
    """Write the files of a layout."""
    folder = folder / DAY
    folder.mkdir(parents=True)
    tables = [layout.order(part) for part in slices(rows, layout.file_rows)]
    files = [str(folder / f"{number:06d}.parquet") for number in range(len(tables))]
    start = time.process_time()
    for path, table in zip(files, tables, strict=True):
        pq.write_table(
            table,
            path,
            row_group_size=layout.row_group_rows,
            write_batch_size=WRITE_BATCH_ROWS,
            **layout.options,
        )
    write_s = time.process_time() - start
    return Measured(layout, files, sum(Path(path).stat().st_size for path in files), write_s)


def read(measured: Measured, gram: str) -> list[tuple[Any, ...]]:
    """Time both queries once, keep the best times, and return the Gram rows but for their file."""
    database = duckdb.connect(config={"threads": 1})
    step = measured.layout.files_per_query
    batches = [measured.files[i : i + step] for i in range(0, len(measured.files), step)]
    source = "read_parquet(getvariable('log_files'), union_by_name => true)"
    sums = ", ".join(f"sum({name})" for name in SIGNALS)
    bare_s, _ = _timed(database, batches, f"SELECT {sums} FROM {source}")
    gram_s, rows = _timed(database, batches, gram, {"feature_set": "signals"})
    measured.bare_s = min(bare_s, measured.bare_s)
    measured.gram_s = min(gram_s, measured.gram_s)
    return sorted(row[2:] for row in rows)


def _timed(
    database: duckdb.DuckDBPyConnection,
    batches: Sequence[Sequence[str]],
    query: str,
    parameters: dict[str, str] | None = None,
) -> tuple[float, list[tuple[Any, ...]]]:
    rows = []
    start = time.process_time()
    for files in batches:
        database.execute("SET VARIABLE log_files = $files", {"files": files})
        rows += database.execute(query, parameters).fetchall()
    return time.process_time() - start, rows


def compare(group: Sequence[Layout], rows: pa.Table, folder: Path, gram: str) -> list[Measured]:
    """Measure some layouts in turn. Asserts that all give the same Gram rows."""
    measured = [write(layout, rows, folder / layout.name) for layout in group]
    expected = read(measured[0], gram)
    for _ in range(ROUNDS):
        for one in measured:
            assert read(one, gram) == expected, one.layout.name
    return measured


def print_table(name: str, measured: Sequence[Measured], rows: int) -> None:
    """Print the figures of some layouts as a Markdown table."""
    heads = (name, "bytes a row", "write, Mrows/s", "sum, Mrows/s", "Gram, Mrows/s", "Gram / sum")
    print(f"\n| {' | '.join(heads)} |")
    print("| --- |" + " ---: |" * 5)
    for one in measured:
        rates = [rows / seconds / 1e6 for seconds in (one.write_s, one.bare_s, one.gram_s)]
        cells = " | ".join(f"{rate:.1f}" for rate in rates)
        size = one.size_bytes / rows
        print(f"| {one.layout.name} | {size:.2f} | {cells} | {one.bare_s / one.gram_s:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_options(parser)
    parser.add_argument("--copies", type=int, default=2)
    parser.add_argument("--only", nargs="+")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(options.root or Path(folder) / "data"))
        prepare(warehouse, options.campaign)
        gram = job_statement(warehouse)
        rows = source_rows(warehouse, options.copies)
        print(f"{rows.num_rows:,} rows of {options.copies} copies", flush=True)
        for name, group in layouts(warehouse.logs.encoding.options()).items():
            if not options.only or name in options.only:
                with tempfile.TemporaryDirectory(dir=folder) as inner:
                    print_table(name, compare(group, rows, Path(inner), gram), rows.num_rows)


if __name__ == "__main__":
    main()
