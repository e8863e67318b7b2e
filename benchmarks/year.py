"""A year of messages of a fleet: received day by day, then selected from, with rollups and without.

    python -m benchmarks.year [--cars 100000] [--days 365] [--folder F] [--keep] [--document FILE]

Each car sends one message a day, from which a model can be learned, all different; a day's messages
are a file, received in one process and then deleted. A run with --folder that was interrupted goes
on with the day after. Then each command runs in a process of its own; its peak memory is its own.
`vehicle_id IS NOT NULL` is true, and no column of rollups: it has the rows read. A command that
reads the rows of more than --rows-days days is left out.

Prints JSON; with --document, writes the table into a page. A year of 100,000 cars takes 18 GB.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

import fleet_slip
from benchmarks.documents import insert
from benchmarks.usage import measured
from fleet_slip.errors import AlarmError
from fleet_slip.grams.rows.rollup import CELLS, DRIVES, VEHICLES
from fleet_slip.warehouse.tables import Warehouse
from tests.support.fleet_messages import messages_of

FIRST_DAY = datetime(2024, 1, 1, 5, tzinfo=UTC)
LATEST_START_S = 18 * 3600
QUARTER_DAYS = 91
LEAST_DAYS = 10
BY_ROWS = "vehicle_id IS NOT NULL"
ALARM = (0, AlarmError.exit_code)
"""A chart of days that differ at random may have an alarm."""

SAME = ("drives", "rows", "models", "winner")
"""What two answers to the same question have in common, to the bit."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=100_000)
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--keep", action="store_true", help="leave the data root in the folder")
    parser.add_argument("--rows-days", type=int, default=30)
    parser.add_argument("--document", type=Path)
    given = parser.parse_args()
    if given.days < LEAST_DAYS:
        parser.error(f"--days: at least {LEAST_DAYS}, of which half train what is monitored")
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    try:
        received = receive_days(folder, given.cars, given.days)
        figures = {"cars": given.cars, "days": given.days, **received}
        figures |= sizes(fleet_slip.open(folder / "data").warehouse)
        figures["commands"] = dict(run_commands(folder / "data", given.days, given.rows_days))
    finally:
        if not given.keep:
            shutil.rmtree(folder)
    print(json.dumps(figures, indent=2))
    if given.document:
        insert(given.document, "year", table_of(figures))


def receive_days(folder: Path, cars: int, days: int) -> dict[str, Any]:
    """Receive the messages of each day that is not there; return what those took."""
    fleet = fleet_slip.open(folder / "data")
    known = folder / "year.json"
    told: dict[str, Any] = {"seconds": [], "bytes": 0}
    if known.exists():
        told = json.loads(known.read_text())
    for day in range(len(told["seconds"]), days):
        midnight = int((FIRST_DAY + timedelta(days=day)).timestamp())
        starts = np.random.default_rng([day, 1]).integers(0, LATEST_START_S, cars)
        file = folder / "messages"
        file.write_bytes(messages_of(cars, midnight + starts, seed=day, label_follows=True))
        began = time.perf_counter()
        (report,) = fleet.receive(file)
        told["seconds"].append(round(time.perf_counter() - began, 3))
        told["bytes"] += file.stat().st_size
        if report.received not in (cars, 0):  # none if it landed just before an interruption
            raise RuntimeError(f"day {day}: {report.received:,} of {cars:,} messages landed")
        known.write_text(json.dumps(told))
        file.unlink()
        say(f"day {day + 1} of {days}: received in {told['seconds'][-1]:.1f} s")
    seconds = told["seconds"]
    return {
        "messages": cars * days,
        "messages_bytes": told["bytes"],
        "receive_s": round(sum(seconds), 1),
        "receive_first_days_s": round(float(np.median(seconds[1:11])), 2),
        "receive_last_days_s": round(float(np.median(seconds[-10:])), 2),
    }


def sizes(warehouse: Warehouse) -> dict[str, int]:
    """Return the bytes of Gram files, and of the parts of their rollups."""
    grams = warehouse.grams.snapshot()
    parts = dict.fromkeys((CELLS, VEHICLES, DRIVES), 0)
    for file in grams.files:
        for part in parts:
            parts[part] += len(grams.table.read_leading_part(file.path, part) or b"")
    return {
        "gram_rows": grams.rows,
        "gram_files": len(grams.files),
        "gram_bytes": grams.size_bytes,
        "cells_bytes": parts[CELLS],
        "hashes_bytes": parts[VEHICLES] + parts[DRIVES],
    }


def run_commands(root: Path, days: int, rows_days: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield what each command took; those with rows must say what those with cells say."""
    for span, cohort in spans(days).items():
        said = {}
        for how, condition in (("", cohort), (" by rows", f"{cohort} AND {BY_ROWS}")):
            if how and days_of(span, days) > rows_days:
                continue
            words = ["select", "--cohort", condition, "--unexamined", "--json"]
            answer, took = run(root, *words)
            said[how] = {name: json.loads(answer)[name] for name in SAME}
            for model in said[how]["models"]:
                del model["gram_rows"]  # the condition, as SQL
            yield f"select, {span}{how}", took
        if len(said) == 2 and said[""] != said[" by rows"]:
            raise RuntimeError(f"{span}: rollups and rows do not give the same answer")
    yield "publish", run(root, "publish", "year", "--force", "--unexamined")[1]
    quarter = spans(days)["the first quarter"]
    yield (
        "publish, the first quarter beside it",
        run(root, "publish", "year", "--cohort", quarter, "--force")[1],
    )
    since = (FIRST_DAY + timedelta(days=days // 2)).date().isoformat()
    yield "monitor", run(root, "monitor", "year@1", "--since", since, answers=ALARM)[1]
    yield "status", run(root, "status", answers=ALARM)[1]
    yield "gram", run(root, "gram")[1]


def spans(days: int) -> dict[str, str]:
    """Return the cohorts that are asked for: all days, those of a quarter, and of one."""
    day = (FIRST_DAY + timedelta(days=days // 2)).date()
    quarter = (FIRST_DAY + timedelta(days=QUARTER_DAYS)).date()
    month = (FIRST_DAY + timedelta(days=20)).date()
    return {
        "all days": "source = 'received'",
        "the first quarter": f"day < DATE '{quarter}'",
        "20 days": f"day < DATE '{month}'",
        "one day": f"day = DATE '{day}'",
    }


def days_of(span: str, days: int) -> int:
    """Return how many days a span has."""
    known = {"the first quarter": QUARTER_DAYS, "20 days": 20, "one day": 1}
    return min(days, known.get(span, days))


def run(root: Path, *words: str, answers: tuple[int, ...] = (0,)) -> tuple[str, dict[str, float]]:
    """Run a command; return what it said, and what it took."""
    program = Path(sys.executable).with_name("fleet-slip")
    usage = measured([str(program), "--root", str(root), *words], answers)
    say(f"{' '.join(words)}: {usage.seconds:.1f} s, {usage.cpu_s:.1f} s of processors")
    took = {
        "seconds": round(usage.seconds, 2),
        "cpu_s": round(usage.cpu_s, 2),
        "peak_mib": round(usage.peak_bytes / 2**20),
    }
    return usage.output, took


def table_of(figures: dict[str, Any]) -> str:
    """Return the commands as a Markdown table."""
    lines = [
        f"| {figures['gram_rows']:,} Gram rows | s | processor seconds | peak MiB |",
        "| --- | ---: | ---: | ---: |",
    ]
    lines += [
        f"| {name} | {took['seconds']:,} | {took['cpu_s']:,} | {took['peak_mib']:,} |"
        for name, took in figures["commands"].items()
    ]
    return "\n".join(lines)


def say(text: str) -> None:
    print(f"{datetime.now(UTC):%H:%M:%S} {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
