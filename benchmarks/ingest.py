"""How fast measured logs come in, by format, and how much memory that takes.

    python -m benchmarks.ingest [--rows 1000000] [--formats parquet,csv,mf4]

Files with eleven signals at 100 Hz are written on the fly, int16 counts with a factor in MF4, and
each is ingested by a process of its own, after a small one of the same format so that all is
loaded. Beside it, pandas and Polars read the same columns and convert them by hand, and asammdf
exports the MF4 file to Parquet. Rows a second are by the clock; those of processor time tell more
where the machine has other work. Memory is the peak of the whole process.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

GOAL_ROWS_PER_S = {"parquet": 4e6, "csv": 2e6, "mf4": 1.5e6}
GOAL_MIB = 512
SIGNALS = {
    "ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s", "steering_wheel": "rad",
    "wheel_fl": "rad/s", "wheel_fr": "rad/s", "wheel_rl": "rad/s", "wheel_rr": "rad/s",
    "steer_fl": "rad", "steer_fr": "rad", "sideslip": "rad",
}  # fmt: skip

_INGEST = """
from fleet_slip.ingest.job import ingest_files
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.files.local_folder import LocalFolder
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
counts = [(pl.col(n) * 1000).round().cast(pl.Int32) for n in {signals!r}]
read({file!r}).select("t", *counts).collect().write_parquet({root!r} + ".parquet")
"""
_PANDAS = """
import pandas as pd
start = clocks()
read = pd.read_parquet if {file!r}.endswith("parquet") else pd.read_csv
rows = read({file!r})
rows[{signals!r}] = (rows[{signals!r}] * 1000).round().astype("int32")
rows.to_parquet({root!r} + ".parquet")
"""
_ASAMMDF = """
from asammdf import MDF
start = clocks()
MDF({file!r}).export("parquet", {root!r})
"""
_PROCESS = """
import json, resource, time
from pathlib import Path
def clocks():
    return time.perf_counter(), time.process_time()
{work}
seconds, cpu_s = (end - begin for end, begin in zip(clocks(), start))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps([seconds, cpu_s, peak]))
"""
WAYS = {
    "parquet": {"fleet_slip": _INGEST, "polars": _POLARS, "pandas": _PANDAS},
    "csv": {"fleet_slip": _INGEST, "polars": _POLARS, "pandas": _PANDAS},
    "mf4": {"fleet_slip": _INGEST, "asammdf": _ASAMMDF},
}


def write_log(file: Path, rows: int) -> None:
    """Write a log in the format of the file's suffix."""
    time_s = np.arange(rows) / 100
    columns = {n: np.round(np.sin(time_s * (1 + i / 7)), 3) for i, n in enumerate(SIGNALS)}
    if file.suffix == ".mf4":
        from asammdf import MDF, Signal  # noqa: PLC0415 - of an extra

        factor: Any = {"a": 0.001, "b": 0.0}
        signals = [
            Signal(np.rint(v * 1000).astype("i2"), time_s, name=n, conversion=factor)
            for n, v in columns.items()
        ]
        with MDF(version="4.10") as mdf:
            mdf.append(signals)
            mdf.save(file, compression=2)
        return
    table = pl.DataFrame({"t": time_s, **columns})
    table.write_parquet(file) if file.suffix == ".parquet" else table.write_csv(file)


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
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--formats", default=",".join(WAYS))
    given = parser.parse_args()
    print(f"{'format':8} {'program':11} {'million rows/s':>14} {'per CPU s':>10} {'MiB':>6}  goal")
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.formats.split(","):
            file, mapping = Path(folder, f"log.{kind}"), Path(folder, f"{kind}.toml")
            small = Path(folder, f"small.{kind}")
            write_log(file, given.rows)
            write_log(small, 1000)
            write_mapping(mapping, kind)
            for program, work in WAYS[kind].items():
                root = str(Path(folder, f"{kind}-{program}"))
                known = {
                    "file": str(file),
                    "small": str(small),
                    "root": root,
                    "mapping": str(mapping),
                }
                code = work.format(**known, rows=given.rows, signals=list(SIGNALS))
                seconds, cpu_s, peak_mib = measure(code)
                speed = given.rows / seconds
                goal = ""
                if program == "fleet_slip":
                    fast = "met" if speed >= GOAL_ROWS_PER_S[kind] else "missed"
                    little = "met" if peak_mib <= GOAL_MIB else "missed"
                    goal = f"{GOAL_ROWS_PER_S[kind] / 1e6:g} {fast}, {GOAL_MIB} MiB {little}"
                shown = f"{speed / 1e6:14.2f} {given.rows / cpu_s / 1e6:10.2f} {peak_mib:6.0f}"
                print(f"{kind:8} {program:11} {shown}  {goal}")


if __name__ == "__main__":
    main()
