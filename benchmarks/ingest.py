"""How fast measured logs are ingested, by format, and the memory that it takes.

    python -m benchmarks.ingest [--rows 100000,1000000] [--formats parquet,csv,mf4]
    python -m benchmarks.ingest --rows 100000000 --formats parquet --drives 30000 [--shuffled]
    python -m benchmarks.ingest --check

The logs have eleven noisy signals at 100 Hz in drives of half an hour; in MF4 they are int16 counts
with a factor. With --drives, a column names that many drives of one day, whose rows are together,
or alternate at random. A process of its own ingests each log, after a small one of the same format,
so that everything is loaded. Memory is the peak of that process.

The reference is a Polars pipeline that scans the same file, scales, rounds to int16 and sinks
Parquet (for MF4, of the same rows as Parquet, and without the confined reader's own time). The
ratio of processor times is comparable between machines, rows per second are not. With several sizes
the slope excludes the costs of a process. --check compares the ratios of `CHECKED_ROWS` with those
recorded here; the exit code is 1 if one has grown by half.

A billion rows take 19 GB as Parquet, 79 as CSV and 13 as MF4, and up to 30 more when stored. If the
temporary folder (`TMPDIR`) has no room, nothing is written.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import pyarrow.parquet as pq

CHUNK, DRIVE = 10**6, 180_000
GOAL_ROWS_PER_S = {"parquet": 3e6, "csv": 2e6, "mf4": 2.5e6}
GOAL_MIB = 512
SAMPLE_ROWS = 100_000
CHECKED_ROWS, RECORDED_RATIOS = 500_000, {"parquet": 3.5, "csv": 2.6}
"""Processor time of an ingest over that of Polars; half a second of it does not grow with rows."""
MAX_GROWTH, ATTEMPTS = 1.5, 2
STORED_BYTES_A_ROW = 30
"""Maximum stored bytes of a row, for the space that a run needs."""
SIGNALS = {
    "ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s", "steering_wheel": "rad",
    "wheel_fl": "rad/s", "wheel_fr": "rad/s", "wheel_rl": "rad/s", "wheel_rr": "rad/s",
    "steer_fl": "rad", "steer_fr": "rad", "sideslip": "rad",
}  # fmt: skip

_INGEST = """
from fleet_slip.ingest.logs import ingest_files
from fleet_slip.catalog.catalog import load_catalog
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
mapping = load_mapping("{mapping}", load_catalog())
warehouse = Warehouse(LocalFolder(Path("{root}")))
list(ingest_files(warehouse, [Path("{small}")], mapping))
start = clocks()
(report,) = ingest_files(warehouse, [Path("{file}")], mapping)
assert report.new and report.counts.ticks == {rows}
"""
_REFERENCE = """
import polars as pl
def convert(log, rows):
    scanned = pl.scan_csv(log) if log.endswith("csv") else pl.scan_parquet(log)
    counts = [(pl.col(name) / 0.001).round().cast(pl.Int16) for name in {signals!r}]
    scanned.with_columns(counts).sink_parquet({root!r} + ".parquet")
    assert pl.scan_parquet({root!r} + ".parquet").select(pl.len()).collect().item() == rows
convert({small!r}, 1000)
start = clocks()
convert({file!r}, {rows})
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


def write_log(file: Path, rows: int, drives: int = 0, *, shuffled: bool = False) -> None:
    """Write a log in the format of the file's suffix, a million rows at a time."""
    tables: Iterator[pl.DataFrame]
    tables = (log_rows(start, min(start + CHUNK, rows)) for start in range(0, rows, CHUNK))
    if drives:
        tables = named_drives(tables, rows, drives, shuffled=shuffled)
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


def require_space(folder: Path, kind: str, rows: int) -> None:
    """End if a log of so many rows, and what becomes of it, has no room in a folder."""
    sample = folder / f"sample.{kind}"
    write_log(sample, SAMPLE_ROWS)
    needed = rows * (sample.stat().st_size / SAMPLE_ROWS + STORED_BYTES_A_ROW)
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


def named_drives(
    tables: Iterable[pl.DataFrame], rows: int, drives: int, *, shuffled: bool
) -> Iterator[pl.DataFrame]:
    """Yield tables with the number of a drive in each row, and its own times."""
    rng, start, before = np.random.default_rng(1), 0, np.zeros(drives, np.int64)
    for table in tables:
        number = (start + np.arange(table.height)) * drives // rows
        trip = pl.Series("trip", rng.integers(0, drives, table.height) if shuffled else number)
        tick = trip.to_frame().select(pl.int_range(pl.len()).over("trip")).to_series().to_numpy()
        time_s = (before[trip] + tick) / 100 + trip.to_numpy() % 1000 * 60
        yield table.with_columns(trip, pl.Series("t", time_s.round(2)))
        before += np.bincount(trip, minlength=drives)
        start += table.height


def _write_mf4(file: Path, tables: Iterable[pl.DataFrame]) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415 - of an extra

    factor: Any = {"a": 0.001, "b": 0.0}
    with MDF(version="4.10") as mdf:
        for number, table in enumerate(tables):
            time_s = table["t"].to_numpy()
            counts = [np.rint(table[n].to_numpy() * 1000).astype("i2") for n in SIGNALS]
            if number:
                mdf.extend(0, [(time_s, None), *((values, None) for values in counts)])
            else:
                named = zip(SIGNALS, counts, strict=True)
                mdf.append(
                    [Signal(values, time_s, name=n, conversion=factor) for n, values in named]
                )
        mdf.save(file, compression=2)


def write_mapping(file: Path, kind: str, drives: int = 0) -> None:
    """Write the mapping of such logs."""
    trips = 'column = "trip"\n' if drives else ""
    clock = "own_clock = true" if kind == "mf4" else 'column = "t"\nunit = "s"'
    signals = "\n".join(f'{n} = {{ column = "{n}", unit = "{u}" }}' for n, u in SIGNALS.items())
    file.write_text(
        f'name = "speed"\n[time]\n{clock}\n[drive]\n{trips}day = 2024-05-31\nvehicle_id = "a"\n'
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
    parser.add_argument("--formats", default=",".join(GOAL_ROWS_PER_S))
    parser.add_argument("--drives", type=int, default=0, help="drives that a column names")
    parser.add_argument("--shuffled", action="store_true", help="whose rows alternate at random")
    parser.add_argument("--check", action="store_true", help="compare with recorded ratios")
    options = parser.parse_args()
    if options.check:
        check_ratios()
        return
    sizes = sorted(int(rows) for rows in options.rows.split(","))
    print(
        f"{'format':8} {'rows':>13} {'million rows/s':>14} {'per CPU s':>10} {'of Polars':>10} "
        f"{'MiB':>6}  goal"
    )
    for kind in options.formats.split(","):
        results = [
            measure_log(kind, rows, options.drives, shuffled=options.shuffled) for rows in sizes
        ]
        if len(sizes) > 1:
            wall, cpu, reference = (
                last - first for first, last in zip(results[0], results[-1], strict=True)
            )
            million = (sizes[-1] - sizes[0]) / 1e6
            print(
                f"{kind:8} {'slope':>13} {million / wall:14.2f} {million / cpu:10.2f} "
                f"{cpu / reference:10.2f}"
            )


def check_ratios() -> None:
    """End with exit code 1 if the ratio of a format has grown, in all of some attempts."""
    for kind, recorded in RECORDED_RATIOS.items():
        limit = MAX_GROWTH * recorded
        for _ in range(ATTEMPTS):
            result = measure_log(kind, CHECKED_ROWS)
            if (ratio := result.cpu_s / result.reference_s) <= limit:
                break
        else:
            raise SystemExit(
                f"{kind}: an ingest takes {ratio:.2f} times the processor time of Polars; the "
                f"record is {recorded}, the limit {limit:.2f}. Profile it, or record the new ratio."
            )


class Measurement(NamedTuple):
    """Seconds of an ingest by the clock and of the processor, and those of the reference."""

    wall_s: float
    cpu_s: float
    reference_s: float


def measure_log(kind: str, rows: int, drives: int = 0, *, shuffled: bool = False) -> Measurement:
    """Ingest a log of this many rows, and convert it by Polars; print and return the figures."""
    with tempfile.TemporaryDirectory() as folder:
        return _measure_log(Path(folder), kind, rows, drives, shuffled=shuffled)


def _measure_log(folder: Path, kind: str, rows: int, drives: int, *, shuffled: bool) -> Measurement:
    require_space(folder, kind, rows)
    file, small, mapping = (folder / n for n in (f"log.{kind}", f"small.{kind}", "mapping.toml"))
    write_log(file, rows, drives, shuffled=shuffled)
    write_log(small, 1000, min(drives, 1))
    write_mapping(mapping, kind, drives)
    root = str(folder / "data")
    work = _INGEST.format(file=file, small=small, root=root, rows=rows, mapping=mapping)
    seconds, cpu_s, peak_mib = measure(work)
    if kind == "mf4":
        file, small = file.with_suffix(".parquet"), small.with_suffix(".parquet")
        write_log(file, rows, drives, shuffled=shuffled)
        write_log(small, 1000, min(drives, 1))
    work = _REFERENCE.format(
        file=str(file), small=str(small), root=root, rows=rows, signals=[*SIGNALS]
    )
    _, reference_s, _ = measure(work)
    fast = "met" if rows / seconds >= GOAL_ROWS_PER_S[kind] else "missed"
    little = "met" if peak_mib <= GOAL_MIB else "missed"
    shown = f"{rows / seconds / 1e6:14.2f} {rows / cpu_s / 1e6:10.2f} {cpu_s / reference_s:10.2f}"
    goal = f"{GOAL_ROWS_PER_S[kind] / 1e6:g} {fast}, {GOAL_MIB} MiB {little}"
    print(f"{kind:8} {rows:13,} {shown} {peak_mib:6.0f}  {goal}", flush=True)
    return Measurement(seconds, cpu_s, reference_s)


if __name__ == "__main__":
    main()
