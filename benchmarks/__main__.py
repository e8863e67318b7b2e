"""Runs the benchmarks that need nothing but minutes, one after the other, and records each.

    python -m benchmarks [NAME ...] [--records FILE]

Their processor times are added to FILE by commit, beside that of a yardstick, work that is always
the same. One that takes a fifth longer than the last five records, both in yardsticks, is named at
the end, and the exit code is 1 (`tests/support/bench_record.py`). The others are run by name:
billion and growth need a folder and time, peers and weka other programs.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.usage import measured
from tests.support.bench_record import (
    Record,
    add_record,
    commit,
    read_records,
    slower_than,
    yardstick,
)

COMMANDS = (
    "start",
    "simulator",
    "simulator_profile",
    "pipeline",
    "ingest --rows 1000000 --formats parquet,csv",
    "cluster",
    "crash --kills 30",
)
RECORDS = Path(__file__).with_name("figures") / "bench.jsonl"


def run(command: str, records: Path) -> str | None:
    """Run a benchmark and record it; return what to say if it is slower than it was."""
    print(f"\n== {command}", flush=True)
    took_s = yardstick()
    usage = measured([sys.executable, "-m", *f"benchmarks.{command}".split()])
    record = Record(commit(), command, round(usage.cpu_s, 2), (took_s + yardstick()) / 2)
    summary = f"{record.cpu_s} s of processors, {record.relative:.2f} yardsticks"
    print(f"{usage.output}{summary} of {record.yardstick_s:.3g} s")
    slower = slower_than(read_records(records), record)
    add_record(records, record)
    return slower


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="by default all")
    parser.add_argument("--records", type=Path, default=RECORDS)
    arguments = parser.parse_args()
    chosen = [
        command_line
        for command_line in COMMANDS
        if not arguments.names or command_line.split()[0] in arguments.names
    ]
    if messages := [*filter(None, (run(command, arguments.records) for command in chosen))]:
        sys.exit("\n".join(messages))


if __name__ == "__main__":
    main()
