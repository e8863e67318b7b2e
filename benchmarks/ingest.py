"""How fast measured logs come in, by format, and how much memory that takes.

    python -m benchmarks.ingest [--rows 100000,1000000] [--formats parquet,csv,mf4] [--only-ours]
        [--course 5]

Files with eleven noisy signals at 100 Hz, in drives of half an hour, are written on the fly, int16
counts with a factor in MF4. Each is ingested by a process of its own, after a small one of the same
format so that all is loaded. Beside it, scripts of a few lines do by hand what can be done so:
Polars and pandas read the file (of MF4 asammdf's data frame), cut drives at gaps, snap rows to
ticks, round signals to int16 counts and write one Parquet file; asammdf exports the MF4 file as it
is. They check nothing, and have the whole file in memory. Rows a second are by the clock; those of
processor time tell more where the machine has other work. Memory is the peak of the whole process,
and `times ours` is by the clock. Of several sizes, the slope is what each further second brings.

With `--course`, so many pairs are ingested instead: the same file of each size, Parquet or CSV, by
a mapping that takes the course from north and east velocity at 10 Hz, and by one that does not.

A thousand million rows take 19 GB as Parquet, 79 as CSV and 13 as MF4, and up to 30 more for each
program: what has no room in the temporary folder (`TMPDIR`) is refused before it is written.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow.parquet as pq

CHUNK, DRIVE = 10**6, 180_000
GOAL_ROWS_PER_S = {"parquet": 4e6, "csv": 2e6, "mf4": 1.5e6}
GOAL_MIB = 512
SAMPLE_ROWS = 100_000
STORED_BYTES_A_ROW = 30
"""What a program makes of a row, at most."""
SIGNALS = {
    "ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s", "steering_wheel": "rad",
    "wheel_fl": "rad/s", "wheel_fr": "rad/s", "wheel_rl": "rad/s", "wheel_rr": "rad/s",
    "steer_fl": "rad", "steer_fr": "rad", "sideslip": "rad",
}  # fmt: skip

_TURNED = 10 + 0.5 * 7 * (1 - (pl.col("t") / 7).cos())
_FIX = (pl.col("t") * 100).round().cast(pl.Int64) % 10 == 0
_VELOCITY = {
    name: pl.when(_FIX).then((20 * part).round(3))
    for name, part in (("north", _TURNED.sin()), ("east", _TURNED.cos()))
}
"""What a receiver of 10 Hz says; null between fixes."""
COURSE = """
course = { north = "north", east = "east", unit = "m/s", antenna_x_m = 0.5, antenna_y_m = 0.0 }
"""

_INGEST = """
from fleet_slip.ingest.load import ingest_files
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
mapping = load_mapping({mapping!r})
warehouse = Warehouse(LocalFolder(Path({root!r})))
list(ingest_files(warehouse, [Path({small!r})], mapping))
start = clocks()
(report,) = ingest_files(warehouse, [Path({file!r})], mapping)
assert report.new and report.counts.ticks == {rows}
"""
_POLARS = """
import polars as pl
start = clocks()
read = pl.scan_parquet if {file!r}.endswith("parquet") else pl.scan_csv
counts = [(pl.col(n) / 0.001).round().cast(pl.Int16) for n in {signals!r}]
begins = (pl.col("t").diff() > 1).fill_null(False)
tick = ((pl.col("t") - pl.col("t").first().over("drive")) * 100).round().cast(pl.Int32)
rows = read({file!r}).with_columns(drive=begins.cum_sum())
rows.select("drive", tick.alias("tick"), *counts).collect().write_parquet({root!r} + ".parquet")
"""
_BY_HAND = """
begins = rows["t"].diff() > 1
rows["drive"] = begins.cumsum()
first = rows.groupby("drive")["t"].transform("first")
rows["tick"] = ((rows["t"] - first) * 100).round().astype("int32")
rows[{signals!r}] = (rows[{signals!r}] / 0.001).round().astype("int16")
rows.drop(columns="t").to_parquet({root!r} + ".parquet")
"""
_PANDAS = (
    """
import pandas as pd
start = clocks()
read = pd.read_parquet if {file!r}.endswith("parquet") else pd.read_csv
rows = read({file!r})
"""
    + _BY_HAND
)
_ASAMMDF_PANDAS = (
    """
from asammdf import MDF
start = clocks()
rows = MDF({file!r}).to_dataframe(channels={signals!r}).reset_index(names="t")
"""
    + _BY_HAND
)
_ASAMMDF = """
from asammdf import MDF
start = clocks()
MDF({file!r}).export("parquet", {root!r})
"""
_PROCESS = """
import json, time
from pathlib import Path
def clocks():
    return time.perf_counter(), time.process_time()
{work}
seconds, cpu_s = (end - begin for end, begin in zip(clocks(), start))
# Not ru_maxrss: a process inherits it from the one that started it.
(told,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
peak = int(told.split()[1]) / 1024
print(json.dumps([seconds, cpu_s, peak]))
"""
WAYS = {
    "parquet": {"fleet_slip": _INGEST, "polars": _POLARS, "pandas": _PANDAS},
    "csv": {"fleet_slip": _INGEST, "polars": _POLARS, "pandas": _PANDAS},
    "mf4": {"fleet_slip": _INGEST, "asammdf": _ASAMMDF, "to_dataframe": _ASAMMDF_PANDAS},
}


def write_log(file: Path, rows: int, *, course: bool = False) -> None:
    """Write a log in the format of the file's suffix, a million rows at a time."""
    tables = (log_rows(start, min(start + CHUNK, rows)) for start in range(0, rows, CHUNK))
    if course:
        tables = (table.with_columns(**_VELOCITY) for table in tables)
    if file.suffix == ".mf4":
        _write_mf4(file, tables)
        return
    if file.suffix == ".parquet":
        first = next(tables).to_arrow()
        with pq.ParquetWriter(file, first.schema, compression="zstd") as sink:
            for table in chain([first], (table.to_arrow() for table in tables)):
                sink.write_table(table, row_group_size=2**17)
        return
    with file.open("wb") as sink:
        for number, table in enumerate(tables):
            table.write_csv(sink, include_header=number == 0)


def require_space(folder: Path, kind: str, rows: int, programs: int) -> None:
    """End if a log of so many rows, and what programs make of it, has no room in a folder."""
    sample = folder / f"sample.{kind}"
    write_log(sample, SAMPLE_ROWS)
    needed = rows * (sample.stat().st_size / SAMPLE_ROWS + programs * STORED_BYTES_A_ROW)
    sample.unlink()
    free = shutil.disk_usage(folder).free
    if needed > 0.9 * free:
        raise SystemExit(
            f"{kind}, {rows:,} rows: {needed / 1e9:.0f} GB are needed, and {free / 1e9:.0f} GB are "
            f"free in {folder.parent}. Free some, or set TMPDIR to a folder on another disk."
        )


def log_rows(start: int, end: int) -> pl.DataFrame:
    """Return waves with noise, a drive of half an hour and then a pause."""
    tick = np.arange(start, end)
    rng = np.random.default_rng(start)
    columns = {
        name: np.round(0.5 * np.sin(tick / 100 * (1 + i / 7)) + rng.normal(0, 0.05, tick.size), 3)
        for i, name in enumerate(SIGNALS)
    }
    return pl.DataFrame({"t": np.round(tick / 100 + tick // DRIVE * 10, 2), **columns})


def _write_mf4(file: Path, tables: Iterable[pl.DataFrame]) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415 - of an extra

    factor: Any = {"a": 0.001, "b": 0.0}
    with MDF(version="4.10") as mdf:
        for number, table in enumerate(tables):
            time_s = table["t"].to_numpy()
            counts = [np.rint(table[n].to_numpy() * 1000).astype("i2") for n in SIGNALS]
            if number:
                mdf.extend(0, [(time_s, None), *((one, None) for one in counts)])
            else:
                named = zip(SIGNALS, counts, strict=True)
                mdf.append([Signal(one, time_s, name=n, conversion=factor) for n, one in named])
        mdf.save(file, compression=2)


def write_mapping(file: Path, kind: str) -> None:
    """Write the mapping of such logs."""
    clock = "own_clock = true" if kind == "mf4" else 'column = "t"\nunit = "s"'
    signals = "\n".join(f'{n} = {{ column = "{n}", unit = "{u}" }}' for n, u in SIGNALS.items())
    file.write_text(
        f'name = "speed"\n[time]\n{clock}\n[drive]\nday = 2024-05-31\nvehicle_id = "a"\n'
        f'vehicle_model = "b"\n[signals]\n{signals}\n'
    )


def measure(work: str) -> tuple[float, float, float]:
    """Return seconds by the clock and of the processor, and peak MiB, of a process at work."""
    code = _PROCESS.format(work=work)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    seconds, cpu_s, peak_mib = json.loads(done.stdout.splitlines()[-1])
    return seconds, cpu_s, peak_mib


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", default="1000000", help="numbers of rows, with commas")
    parser.add_argument("--formats", default=",".join(WAYS))
    parser.add_argument("--only-ours", action="store_true", help="not the other programs")
    parser.add_argument("--course", type=int, metavar="PAIRS", help="with and without a course")
    given = parser.parse_args()
    sizes = sorted(int(rows) for rows in given.rows.split(","))
    if given.course:
        for kind, rows in product(set(given.formats.split(",")) - {"mf4"}, sizes):
            with tempfile.TemporaryDirectory() as folder:
                print(f"{kind:8} {rows:13,} {pairs(Path(folder), kind, rows, given.course)}")
        return
    print(
        f"{'format':8} {'rows':>13} {'program':12} {'million rows/s':>14} {'per CPU s':>10} "
        f"{'MiB':>6} {'times ours':>10}  goal"
    )
    for kind in given.formats.split(","):
        taken = []
        for rows in sizes:
            with tempfile.TemporaryDirectory() as folder:
                taken.append(compare(Path(folder), kind, rows, only_ours=given.only_ours))
        if len(sizes) > 1:
            wall, cpu = (
                (sizes[-1] - sizes[0]) / (taken[-1][i] - taken[0][i]) / 1e6 for i in (0, 1)
            )
            print(f"{kind:8} {'slope':>13} {'fleet_slip':12} {wall:14.2f} {cpu:10.2f}")


def pairs(folder: Path, kind: str, rows: int, count: int) -> str:
    """Return what a course costs beside none, in processor time, of so many pairs."""
    file, small = (folder / f"{name}.{kind}" for name in ("log", "small"))
    for log, size in ((file, rows), (small, 1000)):
        write_log(log, size, course=True)
    mappings = [folder / f"{name}.toml" for name in ("without", "with")]
    for mapping in mappings:
        write_mapping(mapping, kind)
    mappings[1].write_text(mappings[1].read_text() + COURSE)
    cpu_s = np.empty((count, 2))
    for pair, column in np.ndindex(count, 2):
        root, mapping = folder / f"{pair}-{column}", mappings[column]
        given = {"file": str(file), "small": str(small), "root": str(root), "mapping": str(mapping)}
        cpu_s[pair, column] = measure(_INGEST.format(**given, rows=rows))[1]
        shutil.rmtree(root)
    ratios = cpu_s[:, 1] / cpu_s[:, 0]
    without, with_course = np.median(cpu_s, axis=0)
    return (
        f"CPU {without:.2f} s without a course, {with_course:.2f} s with one: "
        f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f}) times"
    )


def compare(folder: Path, kind: str, rows: int, *, only_ours: bool) -> tuple[float, float]:
    """Measure all programs on a file, and print it; return the seconds of ours, and of its CPU."""
    file, small, mapping = (folder / n for n in (f"log.{kind}", f"small.{kind}", "mapping.toml"))
    require_space(folder, kind, rows, 1 if only_ours else len(WAYS[kind]))
    write_log(file, rows)
    write_log(small, 1000)
    write_mapping(mapping, kind)
    ours = 0.0, 0.0
    for program, work in WAYS[kind].items():
        if only_ours and program != "fleet_slip":
            continue
        known = {
            "file": str(file), "small": str(small), "root": str(folder / program),
            "mapping": str(mapping),
        }  # fmt: skip
        seconds, cpu_s, peak_mib = measure(work.format(**known, rows=rows, signals=list(SIGNALS)))
        goal = ""
        if program == "fleet_slip":
            ours = seconds, cpu_s
            fast = "met" if rows / seconds >= GOAL_ROWS_PER_S[kind] else "missed"
            little = "met" if peak_mib <= GOAL_MIB else "missed"
            goal = f"{GOAL_ROWS_PER_S[kind] / 1e6:g} {fast}, {GOAL_MIB} MiB {little}"
        shown = f"{rows / seconds / 1e6:14.2f} {rows / cpu_s / 1e6:10.2f} {peak_mib:6.0f}"
        ratio = f"{ours[0] / seconds:10.2f}" if ours[0] else ""
        print(f"{kind:8} {rows:13,} {program:12} {shown} {ratio}  {goal}", flush=True)
    return ours


if __name__ == "__main__":
    main()
