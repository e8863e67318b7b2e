"""How fast logs become Gram rows and models.

    python -m benchmarks.pipeline [--root DATA] [--campaign waterford] [--threads 1 2]
        [--gram-rows 50000]

The campaign is simulated into the data root first if it is not there (a temporary one by default).
All figures are from one run; each time is the best of several.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.compute as pc

from benchmarks.harness import add_options, durations, simulated
from fleet_slip.catalog.features import PLAIN
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.compute import gram_statement
from fleet_slip.grams.update import update_grams, write_rows
from fleet_slip.models.request import load_model_list
from fleet_slip.models.select import select
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change, absent_columns
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG

ROUNDS = 5
MODELS = load_model_list(CATALOG, "table1")
SIGNALS = CATALOG.signals.gram_signals


def best(function: Callable[[], object]) -> float:
    """Return the shortest time of some calls, in s."""
    return min(durations(function, ROUNDS))


def line(title: str, seconds: float, rows: int, remark: str = "") -> None:
    """Print one measurement."""
    print(f"{title:44s} {seconds * 1e3:9.1f} ms {rows / seconds / 1e6:8.2f} Mrows/s  {remark}")


def absent_from(warehouse: Warehouse) -> tuple[str, ...]:
    """Return the columns of the catalog that no log file has."""
    return absent_columns(warehouse.logs.snapshot().files, CATALOG.signals.stored_columns)


def job_statement(warehouse: Warehouse) -> str:
    """Return the statement with which the Gram job reads the logs."""
    return gram_statement(CATALOG, complete=True, absent=absent_from(warehouse))


def gram_query(warehouse: Warehouse, threads: int) -> None:
    """Compare the Gram query with a bare sum of each column over the same files.

    Of each column that the query reads, and of each numeric column of the files.
    """
    snapshot = warehouse.logs.snapshot()
    database = duckdb.connect(config={"threads": threads})
    database.execute("SET VARIABLE log_files = $files", {"files": snapshot.paths})
    source = "read_parquet(getvariable('log_files'), union_by_name => true)"
    sums = ", ".join(f"sum({name})" for name in SIGNALS)
    bare = f"SELECT {sums} FROM {source}"
    absent = absent_from(warehouse)
    logged = ["tick", *(name for name in CATALOG.signals.signals if name not in absent)]
    sums_of_logged = ", ".join(f"sum({name})" for name in logged)
    grouped = f"SELECT drive_id, {sums} FROM {source} GROUP BY drive_id"
    gram = job_statement(warehouse)
    bare_s = best(lambda: database.execute(bare).fetchall())
    logged_s = best(lambda: database.execute(f"SELECT {sums_of_logged} FROM {source}").fetchall())
    grouped_s = best(lambda: database.execute(grouped).fetchall())
    gram_s = best(lambda: database.execute(gram, {"feature_set": "signals"}).fetchall())
    line(f"bare sum of {len(SIGNALS)} columns, {threads} thread(s)", bare_s, snapshot.rows)
    line("  the same sums by drive", grouped_s, snapshot.rows, f"{bare_s / grouped_s:.2f} of it")
    line(f"  bare sum of all {len(logged)} columns", logged_s, snapshot.rows)
    ratios = f"{bare_s / gram_s:.2f} of the bare sum of its columns, {logged_s / gram_s:.2f} of all"
    line("  Gram query: 77 sums by drive", gram_s, snapshot.rows, ratios)


def operators(warehouse: Warehouse) -> None:
    """Say where the Gram query's time goes on one thread, as DuckDB's profiler tells it."""
    snapshot = warehouse.logs.snapshot()
    database = duckdb.connect(config={"threads": 1})
    database.execute("SET VARIABLE log_files = $files", {"files": snapshot.paths})
    explain = f"EXPLAIN (ANALYZE, FORMAT JSON) {job_statement(warehouse)}"
    profiles = []
    for _ in range(ROUNDS):
        answer = database.execute(explain, {"feature_set": "signals"}).fetchone()
        assert answer is not None
        profiles.append(json.loads(answer[1]))
    profile = min(profiles, key=lambda item: float(item["query"]["total_time"]))
    planning_s = sum(profile[part]["total_time"] for part in ("planner", "optimizer"))
    line("  planning", planning_s, snapshot.rows)
    for operator in sorted(_flat(profile["operator"]), key=lambda item: -item["timing"]):
        if operator["timing"] > 0.001:
            title = f"  {operator['type'].lower()}, {operator['intermediate_rows']:,} rows out"
            size = f"{operator['intermediate_size_bytes'] / 2**20:,.0f} MiB out"
            line(title, operator["timing"], snapshot.rows, size)


def _flat(tree: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for operator in tree:
        yield operator
        yield from _flat(operator.get("children", []))


def incremental(warehouse: Warehouse) -> None:
    """Time the Gram job on a new file of about 1 % of the rows, and on nothing."""
    rows = warehouse.logs.snapshot().rows
    with tempfile.TemporaryDirectory() as folder:
        copy = Warehouse(LocalFolder(Path(folder)))
        logs = warehouse.logs.snapshot()
        actions = []
        for i, file in enumerate(logs.files):
            table = warehouse.logs.read(file.path)
            actions.append(copy.logs.write_file(f"file-{i}", table, file.day))
        copy.logs.snapshot().commit(Change(add=actions))
        (whole_s,) = durations(lambda: update_grams(copy), 1)
        new = table.slice(0, rows // 100)
        day = logs.files[-1].day
        assert day is not None
        action = copy.logs.write_file("new", new, day + timedelta(days=1))
        copy.logs.snapshot().commit(Change(add=[action]))
        start = time.perf_counter()
        report = update_grams(copy)
        new_s = time.perf_counter() - start
        assert report.rows_read == rows // 100
        line("Gram job, everything", whole_s, rows)
        line("  1 % new rows", new_s, rows // 100, f"{new_s / whole_s:.3f} of everything")
        line("  nothing new", best(lambda: update_grams(copy)), rows)


AT_ONCE = 1000


def repeat_drives(root: Path, drives: int, feature_set: str) -> Warehouse:
    """Give a root Gram rows of so many drives of a set, by repeating those that it has."""
    warehouse = Warehouse(LocalFolder(root))
    grams = warehouse.grams.snapshot()
    identity = CATALOG.identity(feature_set)
    parts = [grams.table.read(file.path) for file in grams.files]
    usual = grams.table.usual_schema  # without what few files have
    rows = pa.concat_tables(part.select(usual.names).cast(usual) for part in parts)
    original = rows.filter(pc.equal(rows["feature_set"], identity))
    at = original.schema.get_field_index("drive_id")

    def renamed(copy: int) -> pa.Table:
        names = pc.binary_join_element_wise(original["drive_id"].cast(pa.string()), str(copy), "-")
        return original.set_column(
            at, original.schema.field(at), names.cast(original.schema.field(at).type)
        )

    remaining, copy = drives - len(original), 0
    while remaining > 0:
        parts = []
        while remaining > 0 and sum(map(len, parts)) < AT_ONCE:
            copy += 1
            parts.append(renamed(copy).slice(0, remaining))
            remaining -= len(parts[-1])
        change = Change(add=write_rows(warehouse, parts), note={"job": "gram"})
        warehouse.grams.snapshot().commit(change)
    return warehouse


def selection(warehouse: Warehouse, gram_rows: int) -> None:
    """Time a selection over many Gram rows, reading them included."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "data"
        shutil.copytree(str(warehouse.root), root)
        many = repeat_drives(root, gram_rows, PLAIN)
        seconds = best(lambda: select(load_cohort(many), MODELS))
        refit = best(lambda: load_cohort(many, "mass_kg > 0 AND day >= '2024-05-02'"))
    print(
        f"{'select: 5 models x 5 folds':44s} {seconds * 1e3:9.1f} ms  over {gram_rows:,} Gram "
        f"rows; a cohort of them read in {refit * 1e3:.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_options(parser)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--gram-rows", type=int, default=50_000, help="to select from")
    options = parser.parse_args()
    with simulated(options) as warehouse:
        for threads in options.threads:
            gram_query(warehouse, threads)
        print()
        operators(warehouse)
        print()
        incremental(warehouse)
        print()
        selection(warehouse, options.gram_rows)


if __name__ == "__main__":
    main()
