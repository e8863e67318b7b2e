"""How fast logs become Gram rows and models, beside other ways to the same coefficients.

    python -m benchmarks.pipeline [--root DATA] [--threads 2]

Runs on the `waterford` campaign, which is simulated into the data root first if it is not there
(a temporary one by default). All figures are from one run; each time is the best of several.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
from sklearn.linear_model import LinearRegression

from fleet_slip.campaign import load_campaign
from fleet_slip.cohort import load_cohort
from fleet_slip.gram_job import aggregate, update_grams
from fleet_slip.gram_statement import gram_statement
from fleet_slip.local_folder import LocalFolder
from fleet_slip.model_list import load_model_list
from fleet_slip.selection import select
from fleet_slip.signals import catalogue
from fleet_slip.simulation_job import simulate_campaign
from fleet_slip.storage import Change
from fleet_slip.warehouse import Warehouse

ROUNDS = 5
MODELS = load_model_list("table1")
SIGNALS = catalogue().gram_signals
INPUTS = list(MODELS.model[-1].signals)
LABEL = catalogue().label
COLUMNS = [*INPUTS, LABEL]


def best(function: Callable[[], Any], rounds: int = ROUNDS) -> float:
    """Return the shortest time of some calls, in s."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def line(what: str, seconds: float, rows: int, remark: str = "") -> None:
    """Print one measurement."""
    print(f"{what:44s} {seconds * 1e3:9.1f} ms {rows / seconds / 1e6:8.2f} Mrows/s  {remark}")


def prepare(warehouse: Warehouse) -> None:
    """Simulate the campaign and bring the Gram rows up to date."""
    campaign = load_campaign("waterford")
    with ThreadPoolExecutor(2) as executor:
        simulate_campaign(warehouse, campaign, campaign.days(), executor)
    update_grams(warehouse)
    logs = warehouse.logs.snapshot()
    print(
        f"{logs.rows:,} rows in {len(logs.files)} files: {logs.size_bytes / logs.rows:.2f} bytes a "
        "row, all columns included\n"
    )


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
    every = ", ".join(f"sum({name})" for name in ["tick", *catalogue().signals])
    grouped = f"SELECT drive_id, {sums} FROM {source} GROUP BY drive_id"
    gram = gram_statement(catalogue(), whole=True)
    bare_s = best(lambda: database.execute(bare).fetchall())
    every_s = best(lambda: database.execute(f"SELECT {every} FROM {source}").fetchall())
    grouped_s = best(lambda: database.execute(grouped).fetchall())
    gram_s = best(lambda: database.execute(gram, {"feature_set": "signals"}).fetchall())
    line(f"bare sum of {len(SIGNALS)} columns, {threads} thread(s)", bare_s, snapshot.rows)
    line("  the same sums by drive", grouped_s, snapshot.rows, f"{bare_s / grouped_s:.2f} of it")
    line(f"  bare sum of all {len(catalogue().signals) + 1} columns", every_s, snapshot.rows)
    ratios = f"{bare_s / gram_s:.2f} of the bare sum of its columns, {every_s / gram_s:.2f} of all"
    line("  Gram query: 77 sums by drive", gram_s, snapshot.rows, ratios)


def peers(warehouse: Warehouse, threads: int) -> None:
    """Compare ways from the files to the coefficients of model 5, loading included."""
    paths, rows = warehouse.logs.snapshot().paths, warehouse.logs.snapshot().rows
    found: dict[str, list[float]] = {}
    ways: dict[str, Callable[[list[str]], list[float]]] = {
        "numpy lstsq": _by_lstsq,
        "scikit-learn LinearRegression": _by_scikit_learn,
        "Polars streaming, Gram and solve": _by_polars,
    }
    seconds = best(lambda: found.update({"fleet_slip": _by_grams(warehouse, threads)}))
    line("from files to coefficients: Gram query, exact", seconds, rows)
    for name, way in ways.items():
        other = best(partial(_keep, found, name, way, paths), rounds=3)
        digits = _digits(found[name], found["fleet_slip"])
        line(
            f"  {name}", other, rows, f"{other / seconds:.1f}x the time; {digits:.1f} digits agree"
        )


def _keep(
    found: dict[str, list[float]],
    name: str,
    way: Callable[[list[str]], list[float]],
    paths: list[str],
) -> None:
    found[name] = way(paths)


def _digits(values: list[float], exact: list[float]) -> float:
    errors = np.abs((np.array(values) - np.array(exact)) / np.array(exact))
    return float(-np.log10(max(errors.max(), 1e-16)))


def _by_grams(warehouse: Warehouse, threads: int) -> list[float]:
    from fleet_slip.gram import GramTable, packed_size  # noqa: PLC0415
    from fleet_slip.regression.exact import fit  # noqa: PLC0415

    table = aggregate(warehouse, warehouse.logs.snapshot().files, threads=threads)
    table = table.combine_chunks()
    k = len(SIGNALS)
    grams = GramTable(
        SIGNALS,
        table["n"].to_numpy(),
        table["sums"].combine_chunks().flatten().to_numpy().reshape(-1, k),
        table["products"].combine_chunks().flatten().to_numpy().reshape(-1, packed_size(k)),
    )
    model = fit(grams.total(), INPUTS, LABEL).model
    return [*model.weights.values(), model.offset]


def _read(paths: list[str]) -> Any:
    parts = [pq.read_table(path, columns=COLUMNS, partitioning=None) for path in paths]
    columns = pa.concat_tables(parts)
    return np.column_stack([columns[name].to_numpy().astype(np.float64) for name in COLUMNS])


def _by_lstsq(paths: list[str]) -> list[float]:
    data = _read(paths)
    design = np.column_stack([data[:, :-1], np.ones(len(data))])
    return list(np.linalg.lstsq(design, data[:, -1])[0])


def _by_scikit_learn(paths: list[str]) -> list[float]:
    data = _read(paths)
    model = LinearRegression(tol=0).fit(data[:, :-1], data[:, -1])
    return [*model.coef_, model.intercept_]


def _by_polars(paths: list[str]) -> list[float]:
    x = [pl.col(name).cast(pl.Float64) for name in COLUMNS]
    sums = [pl.len().cast(pl.Float64).alias("n")]
    sums += [a.sum().alias(f"s{i}") for i, a in enumerate(x)]
    sums += [
        (a * b).sum().alias(f"p{i}_{j}") for i, a in enumerate(x) for j, b in enumerate(x[: i + 1])
    ]
    row = pl.scan_parquet(paths).select(sums).collect(engine="streaming").row(0, named=True)
    n, k = row["n"], len(COLUMNS)
    mean = np.array([row[f"s{i}"] for i in range(k)]) / n
    centred = np.array([[row[f"p{max(i, j)}_{min(i, j)}"] for j in range(k)] for i in range(k)])
    centred -= n * np.outer(mean, mean)
    slopes = np.linalg.solve(centred[:-1, :-1], centred[:-1, -1])
    return [*slopes, mean[-1] - mean[:-1] @ slopes]


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
        start = time.perf_counter()
        update_grams(copy)
        whole_s = time.perf_counter() - start
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


def selection(warehouse: Warehouse, gram_rows: int = 50_000) -> None:
    """Time a selection over many Gram rows, reading them included."""
    paths = warehouse.grams.snapshot().paths
    rows = pa.concat_tables([pq.read_table(path) for path in paths])
    rows = rows.filter(pa.compute.equal(rows["feature_set"], "signals"))
    repeats = -(-gram_rows // rows.num_rows)
    many = pa.concat_tables([rows] * repeats).slice(0, gram_rows)
    ids = pa.array([f"drive-{i}" for i in range(gram_rows)])
    many = many.set_column(many.schema.get_field_index("drive_id"), "drive_id", ids)
    with tempfile.TemporaryDirectory() as folder:
        copy = Warehouse(LocalFolder(Path(folder)))
        action = copy.grams.write_file("many", many.cast(copy.grams.schema))
        copy.grams.snapshot().commit(Change(add=[action]))
        seconds = best(lambda: select(load_cohort(copy), MODELS.model, MODELS.folds))
        refit = best(lambda: load_cohort(copy, "mass_kg > 0 AND day >= '2024-05-02'"))
    print(
        f"{'select: 5 models x 5 folds':44s} {seconds * 1e3:9.1f} ms  over {gram_rows:,} Gram "
        f"rows; a cohort of them read in {refit * 1e3:.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--root", type=Path)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(options.root or Path(folder)))
        prepare(warehouse)
        for threads in options.threads:
            gram_query(warehouse, threads)
        print()
        peers(warehouse, max(options.threads))
        print()
        incremental(warehouse)
        print()
        selection(warehouse)


if __name__ == "__main__":
    main()
