"""What Gram rows of changes cost beside those of their columns: processor time of the kernel.

    python -m benchmarks.course_rate ROOT [--seconds 5]

Of the longest drive with a course below ROOT, for each shipped feature set of changes that learns
from it: nanoseconds of one thread a row, the least of many rounds, and the ratio.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

from threadpoolctl import threadpool_limits

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import Workspace
from fleet_slip.files.data_root import data_root
from fleet_slip.grams.rows.drive_parts import Parts
from fleet_slip.grams.rows.drive_rows import LoggedDrive, read_drives
from fleet_slip.grams.rows.windowed_grams import change_sums, drive_sums
from fleet_slip.warehouse.tables import Warehouse


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--seconds", type=float, default=5)
    given = parser.parse_args()
    for name in features().sets:
        if features().feature_set(name).in_time:
            with threadpool_limits(1, user_api="blas"):  # as where Gram rows are computed
                print(json.dumps(measure(Warehouse(data_root(given.root)), name, given.seconds)))


def measure(warehouse: Warehouse, name: str, seconds: float) -> dict[str, Any]:
    """Return the costs of a feature set."""
    known, one = features(), features().feature_set(name)
    inputs = (*one.signals, *one.features, *one.windows)
    plain = ColumnPlan.of(
        (*inputs, catalogue().label), known.rows(one.features), known.definitions(name)
    )
    changes = ColumnPlan.of_set(known, name)
    file = max(warehouse.logs.snapshot().files, key=lambda file: file.rows)
    own, other = (longest(read_drives(warehouse, file, plan)) for plan in (plain, changes))
    with_label, with_course = Workspace(plain), Workspace(changes)
    rows, times = len(own.counts.ticks), one.change_ticks
    columns = least_ns(seconds, lambda: drive_sums(with_label, Parts(), own.counts)) / rows
    changed = least_ns(seconds, lambda: change_sums(with_course, other.counts, times, 15)) / rows
    return {
        "set": name,
        "columns": len(inputs),
        "times": len(times),
        "columns_ns_row": round(columns),
        "changes_ns_row": round(changed),
        "ratio": round(changed / columns, 2),
    }


def longest(drives: Any) -> LoggedDrive:
    """Return the drive of most rows."""
    found: LoggedDrive = max(drives, key=lambda one: len(one.counts.ticks))
    return found


def least_ns(seconds: float, work: Callable[[], Any]) -> float:
    """Return the least processor time of this thread."""
    work()  # compiles the kernel
    least, until = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < until or least == float("inf"):
        started = time.thread_time_ns()
        work()
        least = min(least, time.thread_time_ns() - started)
    return least


if __name__ == "__main__":
    main()
