"""What a night of wrong logs does to a model, with the drives left out that `quality` finds.

    python -m benchmarks.wrong_labels ROOT [NIGHT_ROOT ...] [--seed 0]

Takes a warehouse of simulated drives without faults, in four quarters by day. Two are right, the
third is a night on which all cars, or every third one, log something wrong and well-formed, and the
fourth is for the truth: the model of all signals is trained on what is left of the first three, and
judged on it.

Each NIGHT_ROOT is a night on which nothing is wrong, and all is unlike: ice, load, other cars. What
is left out of it is a false alarm.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from benchmarks.quality import (
    Counts,
    Injected,
    biased,
    inject,
    read_counts,
    reversed_sign,
    scaled,
    stuck,
)
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.monitoring.quality import examine, find_wrong_labels
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.warehouse.tables import Warehouse

LABEL = "sideslip"


def late(signal: str, seconds: float) -> Injected:
    def change(x: Counts, _: np.random.Generator) -> Counts:
        ticks = round(100 * seconds)
        return np.concatenate([np.repeat(x[:1], ticks, axis=0), x[:-ticks]])

    return Injected(f"{signal} {seconds:g} s late", (signal,), ("unrelated",), change)


def drifting(signal: str, physical: float, unit: str) -> Injected:
    count = physical / float(catalogue()[signal].scale)

    def change(x: Counts, _: np.random.Generator) -> Counts:
        return x + count * np.linspace(0, 1, len(x))[:, None]

    return Injected(f"{signal} drifting by {physical:g} {unit}", (signal,), ("noisy",), change)


WRONG = (
    scaled(LABEL, 57.3),
    scaled(LABEL, 1 / 57.3),
    reversed_sign(LABEL),
    late(LABEL, 1.0),
    late(LABEL, 0.3),
    biased(LABEL, math.radians(1), "rad"),
    scaled(LABEL, 2.0),
    scaled(LABEL, 1.5),
    stuck(LABEL),
    stuck("ay"),
    drifting(LABEL, math.radians(2), "rad"),
)


def part(cohort: Cohort, chosen: Callable[[int], bool]) -> Cohort:
    """Return the drives of a cohort of one set of signals that are chosen by number."""
    (table,) = cohort.tables
    mask = np.array([chosen(drive) for drive in range(len(table))])
    return replace(cohort, tables=(table.take(mask),), drives=cohort.drives.filter(mask))


def together(first: Cohort, second: Cohort) -> Cohort:
    """Return the drives of two cohorts that have the same signals as one."""
    (table,), name = first.tables, first.tables[0].signals
    (other,) = (one for one in second.tables if one.signals == name)
    pairs = ((table.n, other.n), (table.sums, other.sums), (table.products, other.products))
    parts = [np.concatenate(pair) for pair in pairs]
    drives = pa.concat_tables([first.drives, second.drives], promote_options="default")
    return replace(first, tables=(GramTable(name, *parts),), drives=drives)


def examined(cohort: Cohort) -> set[str]:
    """Return the drives that are not in order."""
    return {one.drive_id for one in examine(cohort, None, find_wrong_labels(cohort)).findings}


def rmse_deg(train: Cohort, test: Cohort) -> float:
    """Return the error on the truth of the model of all signals that some drives train."""
    (table,), (truth,) = train.tables, test.tables
    inputs = [name for name in table.signals if name != LABEL]
    model = fit(table.total(), inputs, LABEL).model
    sums = error_sums(model, truth.total())
    square = float((sums.pp - 2 * sums.py + sums.yy) / sums.n)
    return math.degrees(math.sqrt(square) * float(catalogue()[LABEL].exact_scale))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("nights", type=Path, nargs="*")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cohort = load_cohort(Warehouse(LocalFolder(options.root)))
    order = np.lexsort([cohort.drives[name].to_pylist() for name in ("drive_id", "day")])
    days = np.empty(len(order), dtype=np.int64)
    days[order] = 4 * np.arange(len(order)) // len(order)
    test, train = part(cohort, lambda i: days[i] == 3), part(cohort, lambda i: days[i] < 3)
    days = days[days < 3]
    ids = train.drives["drive_id"].to_pylist()
    night = np.flatnonzero(days == 2)
    counts = read_counts(options.root, [ids[i] for i in night])
    false = examined(train)
    print(f"{len(ids)} drives in order: {len(false)} false alarms, true RMSE", end=" ")
    print(f"{rmse_deg(train, test):.4f} deg; of two days alone", end=" ")
    print(f"{rmse_deg(part(train, lambda i: days[i] < 2), test):.4f} deg\n")
    for root in options.nights:
        other = load_cohort(Warehouse(LocalFolder(root)))
        both = together(part(train, lambda i: days[i] < 2), other)
        print(f"{root.name}: {len(examined(both))} false alarms, {other.drives.num_rows} drives\n")
    print("| wrong | drives | found | false alarms | RMSE of all | RMSE of what is left |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for fault in WRONG:
        for chosen in (night, night[::3]):
            rng = np.random.default_rng(options.seed)
            wrong = inject(train, chosen, counts, fault, rng)
            found = examined(wrong)
            faulty = {ids[i] for i in chosen}
            left = part(wrong, lambda i, found=found: ids[i] not in found)  # type: ignore[misc]
            print(
                f"| {fault.name} | {len(faulty)} | {len(found & faulty)} | {len(found - faulty)} "
                f"| {rmse_deg(wrong, test):.4f} | {rmse_deg(left, test):.4f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
