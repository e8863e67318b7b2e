"""How long a folder of many small logs takes, and how long it takes to find nothing new in it.

    python -m benchmarks.ingest_folder [--files 2000] [--rows 1000]

Each file is a drive of its own with eleven signals in CSV. The folder is ingested into an empty
data root; then the same call is made once more; then one file more is laid into it.
"""

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl

import fleet_slip
from benchmarks.ingest import write_log, write_mapping


def write_folder(folder: Path, files: int, rows: int) -> None:
    """Write logs of so many rows; no two have the same content."""
    write_log(folder.parent / "whole.csv", rows)
    whole = pl.read_csv(folder.parent / "whole.csv")
    for number in range(files):
        shifted = whole.with_columns(pl.col("t") + number * 100)
        shifted.write_csv(folder / f"drive_{number:06}.csv")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--rows", type=int, default=1000, help="of each file")
    given = parser.parse_args()
    with TemporaryDirectory() as name:
        base = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(base / "cache")
        folder, mapping = base / "landing", base / "mapping.toml"
        folder.mkdir()
        write_folder(folder, given.files + 1, given.rows)
        late = folder / f"drive_{given.files:06}.csv"
        later = late.rename(base / late.name)
        write_mapping(mapping, "csv")
        fleet = fleet_slip.open(base / "data")
        for what in ("all new", "nothing new", "one new"):
            if what == "one new":
                later.rename(late)
            start, cpu = time.perf_counter(), time.process_time()
            reports = fleet.ingest(folder, str(mapping))
            took, cpu = time.perf_counter() - start, time.process_time() - cpu
            print(
                f"{what:12} {len(reports):7,} files {took:8.2f} s {cpu:8.2f} CPU s "
                f"{1e3 * cpu / max(len(reports), 1):7.2f} CPU ms a file",
                flush=True,
            )


if __name__ == "__main__":
    main()
