"""Other ways to write the Gram query, beside the one in use.

    python -m benchmarks.gram_variants [--root DATA] [--campaign waterford] [--only packed]

On a campaign, which is simulated into the data root first if it is not there (a temporary one by
default). CPU time of one thread, the best of several rounds in which the variants
take turns, so that other work on the machine disturbs them little.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import duckdb

from benchmarks.pipeline import SIGNALS, add_options, job_statement, prepare
from fleet_slip.grams.compute import LOGS
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse

ROUNDS = 7
PAIRS = [(a, b) for i, a in enumerate(SIGNALS) for b in SIGNALS[: i + 1]]
SUMS = ", ".join(f"sum({name})" for name in SIGNALS)
IN_USE = "the Gram query in use"


def products(kind: str, aggregate: str = "sum") -> str:
    """Return the sums of products, multiplied in an SQL type."""
    return ", ".join(f"{aggregate}({a}::{kind} * {b}::{kind})" for a, b in PAIRS)


def by_drive(*columns: str, source: str = LOGS, group: str = "drive_id") -> str:
    """Return a query of one row a drive."""
    return f"SELECT {group}, {', '.join(columns)} FROM {source} GROUP BY {group}"


def packed() -> str:
    """Two products in one: a * (b * 2^35 + c). Its cost only: the sums are not taken apart."""
    couples = [SIGNALS[i : i + 2] for i in range(0, len(SIGNALS) - 1, 2)]
    packs = ", ".join(
        f"{b}::BIGINT * 34359738368 + {c} AS pack_{i}" for i, (b, c) in enumerate(couples)
    )
    sums = [
        f"sum({name}::BIGINT * pack_{j})"
        for i, name in enumerate(SIGNALS)
        for j in range((i + 1) // 2)
    ]
    squares = [f"sum({name}::INTEGER * {name}::INTEGER)" for name in SIGNALS[::2]]
    return by_drive(*sums, *squares, source=f"(SELECT *, {packs} FROM {LOGS})")


def lists() -> str:
    """The columns of a drive as lists, and inner products of lists."""
    columns = [f"list({name}::DOUBLE) AS {name}" for name in SIGNALS]
    inner = ", ".join(f"list_inner_product({a}, {b})" for a, b in PAIRS)
    return f"SELECT drive_id, {inner} FROM ({by_drive(*columns)})"


def variants(in_use: str) -> dict[str, str]:
    """Return the queries by what they do; the first is what they are measured against."""
    named = LOGS.replace("union_by_name", "filename => true, union_by_name")
    integer = products("INTEGER")
    first_half = ", ".join(f"sum({a}::INTEGER * {b}::INTEGER)" for a, b in PAIRS[:33])
    return {
        "bare sum of 11 columns": f"SELECT {SUMS} FROM {LOGS}",
        "the same sums by drive": by_drive(SUMS),
        "and 33 products": by_drive(SUMS, first_half),
        "and all 66 products": by_drive(SUMS, integer),
        IN_USE: in_use,
        "a constant beside drive_id in GROUP BY": (
            f"SELECT drive_id, 0 AS absent, {SUMS}, {integer} FROM {LOGS} GROUP BY drive_id, absent"
        ),
        "by file, a constant in each vector": by_drive(
            SUMS, integer, source=named, group="filename"
        ),
        "not grouped": f"SELECT {SUMS}, {integer} FROM {LOGS}",
        "not grouped, DuckDB's internal sum_no_overflow": (
            f"SELECT {SUMS}, {integer} FROM {LOGS}".replace("sum(", "sum_no_overflow(")
        ),
        "by drive, DuckDB's internal sum_no_overflow": (
            by_drive(SUMS, integer).replace("sum(", "sum_no_overflow(")
        ),
        "BIGINT products": by_drive(SUMS, products("BIGINT")),
        "DOUBLE products": by_drive(SUMS, products("DOUBLE")),
        "two products packed in a BIGINT": packed(),
        "groups of 8,192 rows within drives": by_drive(SUMS, integer, group="drive_id, tick >> 13"),
        "lists of doubles and list_inner_product": lists(),
    }


SETTINGS = (
    "preserve_insertion_order = false",
    "parquet_metadata_cache = true",
    "perfect_ht_threshold = 16",
    "disabled_optimizers = 'join_order'",
)


def cpu_s(database: duckdb.DuckDBPyConnection, query: str) -> float:
    """Return the CPU time of a query."""
    parameters = {"feature_set": "signals"} if "$feature_set" in query else None
    start = time.process_time()
    database.execute(query, parameters).fetchall()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_options(parser)
    parser.add_argument("--only", nargs="+", default=[], help="words in the names of variants")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(options.root or Path(folder)))
        prepare(warehouse, options.campaign)
        logs = warehouse.logs.snapshot()

        def connect(setting: str = "threads = 1") -> duckdb.DuckDBPyConnection:
            database = duckdb.connect(config={"threads": 1})
            database.execute(f"SET {setting}")
            database.execute("SET VARIABLE log_files = $files", {"files": logs.paths})
            return database

        usual = connect()
        runs = {name: (usual, query) for name, query in variants(job_statement(warehouse)).items()}
        runs |= {f"SET {one}": (connect(one), runs[IN_USE][1]) for one in SETTINGS}
        first = next(iter(runs))
        chosen = [
            name
            for name in runs
            if name == first or not options.only or any(word in name for word in options.only)
        ]
        best = dict.fromkeys(chosen, math.inf)
        for _ in range(ROUNDS):
            for name in chosen:
                best[name] = min(best[name], cpu_s(*runs[name]))
        print("| query | ns a row | of the bare sum's rate |\n| --- | ---: | ---: |")
        for name, seconds in best.items():
            print(f"| {name} | {seconds / logs.rows * 1e9:.0f} | {best[first] / seconds:.2f} |")


if __name__ == "__main__":
    main()
