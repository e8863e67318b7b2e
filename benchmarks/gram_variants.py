"""Other ways to write the Gram query, beside the one in use.

    python -m benchmarks.gram_variants [--root DATA] [--campaign waterford] [--only DOUBLE]

On a campaign, which is simulated into the data root first if it is not there (a temporary one by
default). CPU time of one thread, the best of several rounds in which the variants
take turns, so that other work on the machine disturbs them little.
"""

import argparse
import math
import time

import duckdb

from benchmarks.harness import add_options, simulated
from benchmarks.pipeline import SIGNALS, job_statement
from fleet_slip.grams.compute import LOGS

ROUNDS = 7
PAIRS = [(a, b) for i, a in enumerate(SIGNALS) for b in SIGNALS[: i + 1]]
SUMS = ", ".join(f"sum({name})" for name in SIGNALS)
IN_USE = "the Gram query in use"


def products(kind: str) -> str:
    """Return the sums of products, multiplied in an SQL type."""
    return ", ".join(f"sum({a}::{kind} * {b}::{kind})" for a, b in PAIRS)


def by_drive(*columns: str) -> str:
    """Return a query of one row a drive."""
    return f"SELECT drive_id, {', '.join(columns)} FROM {LOGS} GROUP BY drive_id"


def lists() -> str:
    """The columns of a drive as lists, and inner products of lists."""
    columns = [f"list({name}::DOUBLE) AS {name}" for name in SIGNALS]
    inner = ", ".join(f"list_inner_product({a}, {b})" for a, b in PAIRS)
    return f"SELECT drive_id, {inner} FROM ({by_drive(*columns)})"


def variants(in_use: str) -> dict[str, str]:
    """Return the queries by what they do; the first is what they are measured against."""
    integer = products("INTEGER")
    return {
        "bare sum of 11 columns": f"SELECT {SUMS} FROM {LOGS}",
        "the same sums by drive": by_drive(SUMS),
        "and all 66 products": by_drive(SUMS, integer),
        IN_USE: in_use,
        "not grouped": f"SELECT {SUMS}, {integer} FROM {LOGS}",
        "DOUBLE products": by_drive(SUMS, products("DOUBLE")),
        "lists of doubles and list_inner_product": lists(),
    }


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
    with simulated(options) as warehouse:
        logs = warehouse.logs.snapshot()
        database = duckdb.connect(config={"threads": 1})
        database.execute("SET VARIABLE log_files = $files", {"files": logs.paths})
        queries = variants(job_statement(warehouse))
        first = next(iter(queries))
        chosen = [
            name
            for name in queries
            if name == first or not options.only or any(word in name for word in options.only)
        ]
        best = dict.fromkeys(chosen, math.inf)
        for _ in range(ROUNDS):
            for name in chosen:
                best[name] = min(best[name], cpu_s(database, queries[name]))
        print("| query | ns a row | of the bare sum's rate |\n| --- | ---: | ---: |")
        for name, seconds in best.items():
            print(f"| {name} | {seconds / logs.rows * 1e9:.0f} | {best[first] / seconds:.2f} |")


if __name__ == "__main__":
    main()
