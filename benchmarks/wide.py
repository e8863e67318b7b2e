"""Gram rows of sets with windows: the compiled kernel against the SQL that defines them.

    python -m benchmarks.wide ROOT [--campaign waterford] [--threads 2] [--rounds 3] [--sql-files 1]
    python -m benchmarks.wide ROOT --campaign proving_ground --shipped gated

For 12, 52, 100 and 200 columns of the logs below ROOT: whether both give the same bits, and how
many rows a second each computes, Parquet reading included, and the kernel's processor time a row,
which other load disturbs less. The kernel reads all files of the campaign, SQL as many as are asked
for, perhaps none. The best of some rounds; columns that are no windows are signals and the label.
With `--solve`, how long the exact regression on all columns takes. With `--shipped`, a set of
configs/features.toml instead: the kernel's time over all drives of a file.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue import features as features_module
from fleet_slip.catalogue.feature_catalogue import FeatureCatalogue
from fleet_slip.catalogue.feature_sets import PLAIN, FeatureSet
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.time_columns import Window
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import Workspace
from fleet_slip.delta import TableFile
from fleet_slip.files.data_root import data_root
from fleet_slip.grams.rows import aggregation, statement, windowed_grams
from fleet_slip.grams.rows.aggregation import aggregate, by_sql
from fleet_slip.grams.rows.drive_parts import Parts
from fleet_slip.grams.rows.drive_rows import read_drives
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.warehouse.tables import Warehouse

COLUMNS = (12, 52, 100, 200)
TICKS = tuple(range(4, 4 + 64 * 16, 16))
SET = "bench"


def catalogue_with(columns: int) -> FeatureCatalogue:
    """Return the shipped features with a set of so many columns, most of them windows.

    Twelve columns are the ten signals, one window and the label.
    """
    known = features()
    inputs = catalogue().inputs
    means = {
        name: one.model_copy(update={"ticks": TICKS})
        for name, one in known.windows.items()
        if one.over in {"mean", "sum"}
    }
    names = [
        member
        for ticks in TICKS
        for family, window in means.items()
        for member in Window.members(window.model_copy(update={"ticks": (ticks,)}), family)
    ]
    chosen = FeatureSet(
        description="benchmark",
        signals=inputs,
        windows=tuple(names[: columns - len(inputs) - 1]),
    )
    windows = {**known.windows, **means}
    emptied: dict[str, Any] = {kind: {} for kind in ("factors", "calibrated", "gates")}
    return known.model_copy(update={**emptied, "windows": windows, "sets": {SET: chosen}})


def best_rate(rows: int, rounds: int, work: Callable[[], pa.Table]) -> tuple[float, pa.Table]:
    """Return millions of rows a second of the best round, and the result."""
    seconds = []
    for _ in range(rounds):
        started = time.perf_counter()
        found = work()
        seconds.append(time.perf_counter() - started)
    return rows / min(seconds) / 1e6, found


def least_cpu_ns_row(rows: int, seconds: float, work: Callable[[], Any]) -> float:
    """Return the least processor time of this thread a row, of as many rounds as there is time."""
    least, until = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < until or least == float("inf"):
        started = time.thread_time()
        work()
        least = min(least, time.thread_time() - started)
    return least / rows * 1e9


def stages(warehouse: Warehouse, file: TableFile, known: FeatureCatalogue) -> dict[str, Any]:
    """Return the processor time of one thread a row, to read a file and to compute its first drive.

    The least of many rounds of some milliseconds, which other load disturbs least.
    """
    plan = ColumnPlan.of_set(known, SET)
    workspace, parts = Workspace(plan), Parts()
    first = next(read_drives(warehouse, file, plan)).counts
    windowed_grams.drive_sums(workspace, parts, first)  # compiles the kernel
    read = least_cpu_ns_row(file.rows, 2, lambda: list(read_drives(warehouse, file, plan)))
    rows = len(first.ticks)
    computed = least_cpu_ns_row(
        rows, 10, lambda: windowed_grams.drive_sums(workspace, parts, first)
    )
    return {"read_cpu_ns_row": round(read), "kernel_cpu_ns_row": round(computed)}


def solve(gram_rows: pa.Table) -> dict[str, Any]:
    """Return the processor time of the exact regression of the label on all columns."""
    names = max(gram_rows["signals"].unique().to_pylist(), key=len)
    rows = gram_rows.filter(pc.equal(gram_rows["signals"], names)).combine_chunks()
    totals = (
        tuple(np.sum([np.asarray(one.values).astype(object) for one in rows[name]], axis=0))
        for name in ("sums", "products")
    )
    gram = Gram(tuple(names.split(",")), pc.sum(rows["n"]).as_py(), *totals)
    started = time.process_time()
    found = fit(gram, gram.signals[:-1], gram.signals[-1])
    return {"solve_cpu_s": round(time.process_time() - started, 1), "inputs": found.size}


def measure_shipped(warehouse: Warehouse, file: TableFile, name: str) -> dict[str, Any]:
    """Return the kernel's processor time a row for a shipped set, over the drives of a file."""
    plan = ColumnPlan.of_set(features(), name)
    workspace = Workspace(plan)
    drives = [one.counts for one in read_drives(warehouse, file, plan)]
    rows = sum(len(one.ticks) for one in drives)

    def work() -> None:
        for drive in drives:
            windowed_grams.drive_sums(workspace, Parts(), drive)

    work()  # compiles the kernel
    spent = least_cpu_ns_row(rows, 10, work)
    return {"columns": len(plan.names), "rows": rows, "kernel_cpu_ns_row": round(spent)}


def files_of(warehouse: Warehouse, campaign: str) -> list[TableFile]:
    """Return the log files of a campaign."""
    return [one for one in warehouse.logs.snapshot().files if f"{campaign}-" in one.path]


def measure(warehouse: Warehouse, columns: int, options: Any) -> dict[str, Any]:
    """Return rates and whether the bits are the same, for so many columns."""
    files = files_of(warehouse, options.campaign)
    few = files[: options.sql_files]
    known = catalogue_with(columns)
    # A copy keeps what was computed of the original.
    known.__dict__.pop("time_columns", None)
    with (
        patch.object(features_module, "features", lambda: known),
        patch.object(aggregation, "features", lambda: known),
        patch.object(statement, "features", lambda: known),
        patch.object(windowed_grams, "features", lambda: known),
    ):
        aggregate(warehouse, files[:1], threads=1, feature_set=SET)  # compiles the kernel
        rows = sum(file.rows for file in files)
        rate, _ = best_rate(
            rows,
            options.rounds,
            lambda: aggregate(warehouse, files, threads=options.threads, feature_set=SET),
        )
        compared: dict[str, Any] = {}
        if options.solve:
            compared = solve(aggregate(warehouse, files[:1], feature_set=SET))
        if few:
            few_rows = sum(file.rows for file in few)
            sql_rate, defined = best_rate(few_rows, 1, lambda: by_sql(warehouse, few, SET))
            kernel = aggregate(warehouse, few, threads=options.threads, feature_set=SET)
            compared |= {
                "sql_million_rows_s": round(sql_rate, 3),
                "same_bits": kernel.equals(defined.cast(kernel.schema)),
            }
    return {
        "columns": columns,
        "windows": len(known.feature_set(SET).windows),
        "rows": rows,
        "threads": options.threads,
        "kernel_million_rows_s": round(rate, 2),
        **stages(warehouse, files[0], known),
        **compared,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--campaign", default="waterford")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--sql-files", type=int, default=1)
    parser.add_argument("--columns", type=int, nargs="*", default=COLUMNS)
    parser.add_argument("--solve", action="store_true")
    parser.add_argument("--shipped", metavar="SET")
    options = parser.parse_args()
    warehouse = Warehouse(data_root(options.root))
    files = files_of(warehouse, options.campaign)
    if options.shipped:
        print(json.dumps(measure_shipped(warehouse, files[0], options.shipped)))
        return
    plain, _ = best_rate(
        sum(file.rows for file in files),
        options.rounds,
        lambda: aggregate(warehouse, files, threads=options.threads, feature_set=PLAIN),
    )
    print(json.dumps({"plain_sql_million_rows_s": round(plain, 2)}), flush=True)
    for columns in options.columns:
        print(json.dumps(measure(warehouse, columns, options)), flush=True)


if __name__ == "__main__":
    main()
