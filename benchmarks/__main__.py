"""Runs the benchmarks that need nothing but minutes, one after the other, and records each.

    python -m benchmarks [NAME ...] [--records FILE] [--plot FILE]

Their processor times are added to FILE by commit, beside that of a yardstick, work that is always
the same, and drawn over commits. One that takes a fifth longer than the last five records, both in
yardsticks, is named at the end, as is every figure marked in a page that is more than a fifth
another (`tests/support/bench_record.py`), and the exit code is 1. The others are run by name:
billion and growth need a folder and time, peers and weka other programs.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.usage import measured
from tests.support.bench_record import (
    PageFigure,
    Record,
    add_record,
    commit,
    draw,
    page_figures,
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
PAGES = Path(__file__).parents[1] / "docs"


def run(command: str, records: Path, figures: Sequence[PageFigure]) -> Iterator[str]:
    """Run a benchmark, record it, and yield what is slower or other than it was."""
    print(f"\n== {command}", flush=True)
    took_s = yardstick()
    usage = measured([sys.executable, "-m", *f"benchmarks.{command}".split()])
    record = Record(commit(), command, round(usage.cpu_s, 2), (took_s + yardstick()) / 2)
    summary = f"{record.cpu_s} s of processors, {record.relative:.2f} yardsticks"
    print(f"{usage.output}{summary} of {record.yardstick_s:.3g} s")
    if slower := slower_than(read_records(records), record):
        yield slower
    add_record(records, record)
    for figure in figures:
        if figure.benchmark == command.partition(" ")[0]:
            yield from filter(None, [figure.departure(usage.output, record.yardstick_s)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="by default all")
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--plot", type=Path, help="by default beside the records")
    given = parser.parse_args()
    chosen = [one for one in COMMANDS if not given.names or one.split()[0] in given.names]
    figures = list(page_figures(sorted(PAGES.glob("*.md"))))
    told = [one for command in chosen for one in run(command, given.records, figures)]
    draw(read_records(given.records), given.plot or given.records.with_suffix(".svg"))
    if told:
        sys.exit("\n".join(told))


if __name__ == "__main__":
    main()
