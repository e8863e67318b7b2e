"""Ways from log files to the coefficients of one model, each in a process of its own.

    python -m benchmarks.peer_ways WAY THREADS RUNS FILE...

prints one line of JSON: the coefficients of the inputs and the intercept of each run, the best time
in s and the peak memory. Imports and the start of a JVM are not counted, reading the files is.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fleet_slip.models.request import load_model_list
from tests.support.catalog import CATALOG, SIGNALS

INPUTS = list(load_model_list(CATALOG, "table1").model[-1].signals)
LABEL = SIGNALS.label
COLUMNS = [*INPUTS, LABEL]
SOURCE = "read_parquet(getvariable('log_files'), union_by_name => true)"

Coefficients = list[float]
Fit = Callable[[list[str]], Coefficients]
"""From paths of log files to the coefficients and the intercept."""


@dataclass(frozen=True)
class Way:
    """One program. `prepare` takes a number of threads, imports and starts what is needed.

    Coefficients are of counts, or of `physical` values.
    """

    name: str
    prepare: Callable[[int], Fit]
    package: str = ""
    physical: bool = False


def _read(paths: list[str]) -> NDArray[np.float64]:
    parts = [pq.read_table(path, columns=COLUMNS, partitioning=None) for path in paths]
    columns = pa.concat_tables(parts)
    data = np.empty((columns.num_rows, len(COLUMNS)), order="F")
    for i, name in enumerate(COLUMNS):
        data[:, i] = columns[name].to_numpy()
    return data


def fleet_slip(threads: int) -> Fit:
    from fleet_slip.grams.compute import FILES_PER_QUERY, gram_statement  # noqa: PLC0415
    from fleet_slip.regression.gram import Gram  # noqa: PLC0415
    from fleet_slip.regression.least_squares import fit  # noqa: PLC0415

    def run(paths: list[str]) -> Coefficients:
        logged = pq.read_schema(paths[0]).names
        absent = [name for name in SIGNALS.stored_columns if name not in logged]
        statement = gram_statement(CATALOG, complete=True, absent=absent)
        database = duckdb.connect(config={"threads": threads})
        total = Gram.zero(SIGNALS.gram_signals)
        for first in range(0, len(paths), FILES_PER_QUERY):
            batch = paths[first : first + FILES_PER_QUERY]
            database.execute("SET VARIABLE log_files = $files", {"files": batch})
            rows = database.sql(statement, params={"feature_set": "signals"})
            for row in rows.to_arrow_table().to_pylist():
                signals = tuple(row["signals"].split(","))
                total += Gram(signals, row["n"], tuple(row["sums"]), tuple(row["products"]))
        model = fit(total, INPUTS, LABEL).model
        return [*model.weights.values(), model.offset]

    return run


def numpy_lstsq(_threads: int) -> Fit:
    def run(paths: list[str]) -> Coefficients:
        data = _read(paths)
        design = np.column_stack([data[:, :-1], np.ones(len(data))])
        return [float(b) for b in np.linalg.lstsq(design, data[:, -1])[0]]

    return run


def scikit_learn(_threads: int) -> Fit:
    from sklearn.linear_model import LinearRegression  # noqa: PLC0415

    def run(paths: list[str]) -> Coefficients:
        data = _read(paths)
        model = LinearRegression().fit(data[:, :-1], data[:, -1])
        return [*(float(b) for b in model.coef_), float(model.intercept_)]

    return run


def statsmodels(_threads: int) -> Fit:
    from statsmodels.api import OLS, add_constant  # noqa: PLC0415

    def run(paths: list[str]) -> Coefficients:
        data = _read(paths)
        model = OLS(data[:, -1], add_constant(data[:, :-1], prepend=False)).fit()
        return [float(b) for b in model.params]

    return run


def _solved(n: float, sums: NDArray[np.float64], products: NDArray[np.float64]) -> Coefficients:
    """Solve the centred normal equations in float64."""
    mean = sums / n
    centred = products - n * np.outer(mean, mean)
    slopes = np.linalg.solve(centred[:-1, :-1], centred[:-1, -1])
    return [*(float(b) for b in slopes), float(mean[-1] - mean[:-1] @ slopes)]


def _unpacked(row: tuple[float, ...]) -> Coefficients:
    """Solve from n, the sums and the lower triangle of the sums of products."""
    k = len(COLUMNS)
    products = np.zeros((k, k))
    products[np.tril_indices(k)] = row[1 + k :]
    products += np.tril(products, -1).T
    return _solved(row[0], np.array(row[1 : 1 + k], float), products)


def _scale(name: str, *, physical: bool) -> float:
    return float(SIGNALS[name].scale) if physical else 1.0


def duckdb_float(threads: int) -> Fit:
    x = [f"{name}::DOUBLE" for name in COLUMNS]
    sums = [f"sum({a})" for a in x]
    products = [f"sum({a} * {b})" for i, a in enumerate(x) for b in x[: i + 1]]
    query = f"SELECT count(*), {', '.join([*sums, *products])} FROM {SOURCE}"

    def run(paths: list[str]) -> Coefficients:
        database = duckdb.connect(config={"threads": threads})
        database.execute("SET VARIABLE log_files = $files", {"files": paths})
        row = database.execute(query).fetchone()
        assert row is not None
        return _unpacked(row)

    return run


def polars_streaming(_threads: int, *, physical: bool = False) -> Fit:
    import polars as pl  # noqa: PLC0415

    x = [pl.col(name).cast(pl.Float64) * _scale(name, physical=physical) for name in COLUMNS]
    aggregates = [pl.len()] + [a.sum().alias(f"s{i}") for i, a in enumerate(x)]
    aggregates += [
        (a * b).sum().alias(f"p{i}_{j}") for i, a in enumerate(x) for j, b in enumerate(x[: i + 1])
    ]

    def run(paths: list[str]) -> Coefficients:
        return _unpacked(
            pl.scan_parquet(paths).select(aggregates).collect(engine="streaming").row(0)
        )

    return run


def spark_mllib(threads: int) -> Fit:
    from pyspark.ml.feature import VectorAssembler  # noqa: PLC0415
    from pyspark.ml.regression import LinearRegression  # noqa: PLC0415
    from pyspark.sql import SparkSession  # noqa: PLC0415

    session = (
        SparkSession.builder.master(f"local[{threads}]")
        .config("spark.ui.enabled", "false")
        .config("spark.driver.memory", "4g")
        .config("spark.ui.showConsoleProgress", "false")
        .getOrCreate()
    )
    vectors = VectorAssembler(inputCols=INPUTS, outputCol="features")
    regression = LinearRegression(labelCol=LABEL, solver="normal")

    def run(paths: list[str]) -> Coefficients:
        rows = session.read.parquet(*paths).select(*COLUMNS)
        model = regression.fit(vectors.transform(rows))
        return [*(float(b) for b in model.coefficients), float(model.intercept)]

    return run


WAYS = {
    "fleet_slip": Way("fleet_slip: integers, exact solve", fleet_slip),
    "duckdb": Way("DuckDB, float64 of counts", duckdb_float),
    "polars": Way("Polars streaming, float64 of counts", polars_streaming),
    "polars-physical": Way(
        "Polars streaming, float64 of physical values",
        partial(polars_streaming, physical=True),
        physical=True,
    ),
    "lstsq": Way("numpy lstsq", numpy_lstsq),
    "scikit-learn": Way("scikit-learn LinearRegression", scikit_learn, "sklearn"),
    "statsmodels": Way("statsmodels OLS", statsmodels, "statsmodels"),
    "spark": Way("Spark MLlib, normal equations", spark_mllib, "pyspark"),
}


def thread_variables(threads: int) -> dict[str, str]:
    """Return the environment variables that limit the threads of the libraries."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS", "RAYON_NUM_THREADS")
    return dict.fromkeys(names, str(threads))


def peak_bytes() -> int:
    """Return the peak resident memory of this process and of those that it has started."""
    me = str(os.getpid())
    total = 0
    for status in Path("/proc").glob("[0-9]*/status"):
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        if me in (fields["Pid"].strip(), fields["PPid"].strip()) and "VmHWM" in fields:
            total += int(fields["VmHWM"].split()[0]) * 1024
    return total


def main() -> None:
    way, threads, runs, *paths = sys.argv[1:]
    fit = WAYS[way].prepare(int(threads))
    coefficients: list[Coefficients] = []
    times: list[float] = []
    processor: list[float] = []
    for _ in range(int(runs)):
        start, used = time.perf_counter(), time.process_time()
        coefficients.append(fit(paths))
        times.append(time.perf_counter() - start)
        processor.append(time.process_time() - used)
    result: dict[str, Any] = {
        "coefficients": coefficients,
        "s": min(times),
        "peak_bytes": peak_bytes(),
    }
    result["processor_s"] = min(processor)
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
