"""The paper's own way: two million rows in WEKA's memory, and the same rows by Gram rows.

    apt-get install weka                    # or unpack the package: dpkg-deb -x weka_*.deb FOLDER
    pip install --group peers -c constraints.txt        # py4j, which starts the JVM
    python -m benchmarks.weka [--root DATA] [--campaign waterford] [--rows 2000000]
        [--jar /usr/share/java/weka.jar]

Rows are the first ones of the campaign, which is simulated into the data root first if it is not
there (a temporary one by default). WEKA reads them from an ARFF file of counts; its time
is given with and without reading. Without the jar, or without py4j, nothing is measured.
"""

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from benchmarks.harness import add_options, peak_bytes, simulated
from benchmarks.peer_ways import COLUMNS, INPUTS
from benchmarks.peers import digits, exact_model, in_process
from fleet_slip.regression.least_squares import LinearModel
from fleet_slip.warehouse.warehouse import Warehouse

JAR = Path("/usr/share/java/weka.jar")


def first_rows(warehouse: Warehouse, count: int) -> pa.Table:
    """Return the first rows of the logs, all columns."""
    tables = [pq.read_table(path, partitioning=None) for path in warehouse.logs.snapshot().paths]
    return pa.concat_tables(tables).unify_dictionaries().slice(0, count)


def write_arff(rows: pa.Table, path: Path) -> None:
    """Write the model's columns as WEKA's text format, the label last."""
    with path.open("wb") as file:
        header = ["@relation logs", *(f"@attribute {name} numeric" for name in COLUMNS), "@data"]
        file.write(("\n".join(header) + "\n").encode())
        options = pa.csv.WriteOptions(include_header=False)
        pa.csv.write_csv(rows.select(COLUMNS), file, options)


def write_parquet(warehouse: Warehouse, rows: pa.Table, folder: Path) -> str:
    """Write the rows as a log file."""
    path = folder / "day=2024-05-01" / "rows.parquet"
    path.parent.mkdir()
    pq.write_table(rows, path, **warehouse.logs.encoding.options())
    return str(path)


def by_weka(jar: Path, arff: Path, *, plain: bool) -> tuple[list[float], float, float, int]:
    """Fit WEKA's LinearRegression in a JVM of its own.

    `plain` switches off its selection of attributes and its ridge. Returns the coefficients of the
    inputs and the intercept, the times of reading and of fitting in s, and the peak memory.
    """
    from py4j.java_gateway import (  # noqa: PLC0415
        GatewayParameters,
        JavaGateway,
        launch_gateway,
    )

    port, process = launch_gateway(
        classpath=str(jar), javaopts=["-Xmx8g"], die_on_exit=True, return_proc=True
    )
    gateway = JavaGateway(gateway_parameters=GatewayParameters(port=port))
    jvm: Any = gateway.jvm
    start = time.perf_counter()
    data = jvm.weka.core.Instances(jvm.java.io.FileReader(str(arff)))
    data.setClassIndex(len(COLUMNS) - 1)
    read_s = time.perf_counter() - start
    regression = jvm.weka.classifiers.functions.LinearRegression
    model = regression()
    if plain:
        none = jvm.weka.core.SelectedTag(1, regression.TAGS_SELECTION)
        model.setAttributeSelectionMethod(none)
        model.setEliminateColinearAttributes(False)
        model.setRidge(0.0)
    start = time.perf_counter()
    model.buildClassifier(data)
    fit_s = time.perf_counter() - start
    coefficients = [float(b) for b in model.coefficients()]
    peak = peak_bytes(process.pid)
    gateway.shutdown()
    process.stdin.close()
    process.wait()
    return [*coefficients[: len(INPUTS)], coefficients[-1]], read_s, fit_s, peak


def print_row(name: str, seconds: Sequence[float], peak_bytes: int, fit: str) -> None:
    cells = " | ".join(f"{value:.2f}" for value in seconds)
    print(f"| {name} | {cells} | {peak_bytes / 2**20:,.0f} | {fit} |", flush=True)


def measure(warehouse: Warehouse, jar: Path, count: int, folder: Path) -> None:
    """Print the table."""
    rows = first_rows(warehouse, count)
    arff = folder / "rows.arff"
    write_arff(rows, arff)
    path = write_parquet(warehouse, rows, folder)
    exact: LinearModel = exact_model([path])
    sizes = [Path(file).stat().st_size / 2**20 for file in (arff, path)]
    print(f"{len(rows):,} rows: ARFF {sizes[0]:,.0f} MiB, log file {sizes[1]:,.0f} MiB\n")
    print("| program | all, s | fit alone, s | peak MiB | inputs used; correct digits |")
    print("| --- | ---: | ---: | ---: | --- |", flush=True)
    for name, plain in (("WEKA, its defaults", False), ("WEKA, all inputs, no ridge", True)):
        coefficients, read_s, fit_s, peak = by_weka(jar, arff, plain=plain)
        used = sum(b != 0 for b in coefficients[:-1])
        fit = f"{used} of {len(INPUTS)}; {max(0.0, digits(coefficients, exact)):.1f}"
        print_row(name, (read_s + fit_s, fit_s), peak, fit)
    for threads in (1, 2):
        ours = in_process("fleet_slip", threads, 3, [path])
        fit = f"{len(INPUTS)} of {len(INPUTS)}; {digits(ours['coefficients'][0], exact):.1f}"
        name = f"fleet_slip, {threads} thread{'s' if threads > 1 else ''}"
        print_row(name, (ours["s"], ours["s"]), ours["peak_bytes"], fit)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_options(parser)
    parser.add_argument("--rows", type=int, default=2_000_000)
    parser.add_argument("--jar", type=Path, default=JAR)
    options = parser.parse_args()
    if not options.jar.exists():
        sys.exit(f"{options.jar}: not there. Run: apt-get install weka, or give --jar")
    if importlib.util.find_spec("py4j") is None:
        sys.exit("py4j is not installed. Run: pip install --group peers -c constraints.txt")
    with simulated(options) as warehouse, tempfile.TemporaryDirectory() as folder:
        measure(warehouse, options.jar, options.rows, Path(folder))


if __name__ == "__main__":
    main()
