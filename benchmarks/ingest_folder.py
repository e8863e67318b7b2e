"""How long a folder of many small logs takes, and how long it takes to find nothing new in it.

    python -m benchmarks.ingest_folder [--files 2000] [--rows 1000] [--format csv]

Each file is a drive of its own with eleven signals, in CSV or Parquet. The folder is ingested into
an empty data root; then the same call is made once more; then one file more is laid into it. Memory
is the peak of the process since it began to ingest.
"""

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import fleet_slip
from benchmarks.harness import peak_bytes
from benchmarks.ingest import log_rows, write_mapping


def write_folder(folder: Path, files: int, rows: int, kind: str) -> None:
    """Write logs of so many rows; no two have the same content."""
    for number in range(files):
        table = log_rows(number * rows, (number + 1) * rows)
        file = folder / f"drive_{number:06}.{kind}"
        table.write_csv(file) if kind == "csv" else table.write_parquet(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--rows", type=int, default=1000, help="of each file")
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    arguments = parser.parse_args()
    with TemporaryDirectory() as name:
        base = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(base / "cache")
        folder, mapping = base / "landing", base / "mapping.toml"
        folder.mkdir()
        write_folder(folder, arguments.files + 1, arguments.rows, arguments.format)
        late = folder / f"drive_{arguments.files:06}.{arguments.format}"
        later = late.rename(base / late.name)
        write_mapping(mapping, arguments.format)
        fleet = fleet_slip.open(base / "data")
        Path("/proc/self/clear_refs").write_text("5")  # the peak of writing does not count
        for title in ("all new", "nothing new", "one new"):
            if title == "one new":
                later.rename(late)
            start, cpu = time.perf_counter(), time.process_time()
            reports = fleet.ingest(folder, str(mapping))
            took, cpu = time.perf_counter() - start, time.process_time() - cpu
            print(
                f"{title:12} {len(reports):7,} files {took:8.2f} s {cpu:8.2f} CPU s "
                f"{1e3 * cpu / max(len(reports), 1):7.2f} CPU ms a file "
                f"{peak_bytes() / 2**20:6.0f} MiB",
                flush=True,
            )


if __name__ == "__main__":
    main()
