"""How many simulated sensor faults `fleet-slip quality` finds, and how often it cries wolf.

    python -m benchmarks.quality ROOT

Takes a warehouse that was simulated without faults, brings one fault into the counts of a twentieth
of its drives (at least four), reduces these to Gram rows again and examines the whole warehouse.
One fault at a time; every row of the table is a warehouse of its own.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.catalog.signals import COUNT_MAX
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.operations.sensor_screen import QualityReport, examine, find_wrong_labels
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import connect
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS

Counts = NDArray[np.float64]
Change = Callable[[Counts, np.random.Generator], Counts]

SEED = 20180418
SHARE = 0.05


@dataclass(frozen=True)
class Injected:
    """A fault: what it does to the counts of its signals, rows by signals, and its right name."""

    name: str
    signals: tuple[str, ...]
    kinds: tuple[str, ...]
    change: Change


def biased(signal: str, physical: float, unit: str) -> Injected:
    count = physical / float(SIGNALS[signal].scale)
    return Injected(
        f"{signal} + {physical:g} {unit}", (signal,), ("biased",), lambda x, _: x + count
    )


def scaled(signal: str, factor: float) -> Injected:
    return Injected(f"{signal} x {factor:g}", (signal,), ("scaled",), lambda x, _: x * factor)


def noisy(signal: str, physical: float, unit: str) -> Injected:
    count = physical / float(SIGNALS[signal].scale)
    return Injected(
        f"{signal} with noise of {physical:g} {unit}",
        (signal,),
        ("noisy",),
        lambda x, rng: x + count * rng.standard_normal(x.shape),
    )


def reversed_sign(signal: str) -> Injected:
    return Injected(f"{signal} reversed", (signal,), ("reversed",), lambda x, _: -x)


def swapped(a: str, b: str) -> Injected:
    return Injected(f"{a} and {b} swapped", (a, b), ("swapped",), lambda x, _: x[:, ::-1])


def stuck(signal: str) -> Injected:
    return Injected(f"{signal} stuck", (signal,), ("stuck",), lambda x, _: np.full_like(x, x[0]))


def stuck_half(signal: str) -> Injected:
    def change(x: Counts, _: np.random.Generator) -> Counts:
        middle = len(x) // 2
        return np.concatenate([x[:middle], np.full_like(x[middle:], x[middle])])

    return Injected(f"{signal} stuck from half-way", (signal,), ("noisy",), change)


def clipped(signal: str, share: float) -> Injected:
    def change(x: Counts, _: np.random.Generator) -> Counts:
        end = share * np.abs(x).max()
        return np.clip(x, -end, end)

    name = f"{signal} clipped at {share:.0%} of its peak"
    return Injected(name, (signal,), ("noisy", "scaled"), change)


FAULTS = (
    stuck("ay"),
    stuck("yaw_rate"),
    stuck("wheel_rl"),
    stuck("steering_wheel"),
    stuck_half("ay"),
    stuck_half("wheel_rl"),
    stuck_half("steering_wheel"),
    reversed_sign("ay"),
    reversed_sign("yaw_rate"),
    reversed_sign("steering_wheel"),
    reversed_sign("steer_fl"),
    swapped("wheel_fl", "wheel_fr"),
    swapped("wheel_rl", "wheel_rr"),
    swapped("steer_fl", "steer_fr"),
    biased("ay", 0.5, "m/s2"),
    biased("ay", 2.0, "m/s2"),
    biased("yaw_rate", 0.03, "rad/s"),
    biased("yaw_rate", 0.1, "rad/s"),
    biased("steering_wheel", 0.05, "rad"),
    biased("steer_fr", 0.005, "rad"),
    biased("sideslip", 0.0175, "rad"),
    scaled("ax", 1.2),
    scaled("ay", 1.2),
    scaled("yaw_rate", 1.1),
    scaled("yaw_rate", 1.3),
    scaled("wheel_fl", 1.01),
    scaled("wheel_rr", 0.9),
    scaled("steering_wheel", 1.05),
    scaled("sideslip", 2.0),
    noisy("ay", 1.0, "m/s2"),
    noisy("yaw_rate", 0.05, "rad/s"),
    noisy("wheel_fl", 0.5, "rad/s"),
    noisy("steering_wheel", 0.02, "rad"),
    noisy("sideslip", 0.01, "rad"),
    clipped("ay", 0.5),
    clipped("yaw_rate", 0.5),
    clipped("steering_wheel", 0.5),
)


@dataclass(frozen=True)
class Score:
    """How an examination did."""

    faulty: int
    detected: int
    right_signal: int
    right_kind: int
    clean: int
    false_alarms: int


def sample(cohort: Cohort, rng: np.random.Generator) -> NDArray[np.intp]:
    """Choose the drives that get a fault."""
    drives = cohort.drives.num_rows
    return np.sort(rng.choice(drives, max(4, round(SHARE * drives)), replace=False))


def read_counts(root: Path, drives: Sequence[str]) -> Mapping[str, Counts]:
    """Read the counts of drives, rows by signals of a Gram row."""
    names = SIGNALS.gram_signals
    with connect(root) as database:
        rows = database.execute(
            f"SELECT drive_id, tick, {', '.join(names)} FROM log_counts "
            "WHERE drive_id IN (SELECT unnest($drives)) ORDER BY drive_id, tick",
            {"drives": list(drives)},
        ).fetchnumpy()
    ids, starts = np.unique(np.asarray(rows["drive_id"]), return_index=True)
    counts = np.stack([np.asarray(rows[name], dtype=np.float64) for name in names], axis=1)
    parts = np.split(counts, starts[1:])
    return dict(zip(ids.tolist(), parts, strict=True))


def inject(
    cohort: Cohort,
    chosen: NDArray[np.intp],
    counts: Mapping[str, Counts],
    fault: Injected,
    rng: np.random.Generator,
) -> Cohort:
    """Return the cohort with the fault in the chosen drives."""
    (table,) = cohort.tables
    at = [table.signals.index(signal) for signal in fault.signals]
    ids = cohort.drives["drive_id"].to_pylist()
    parts: list[Any] = [table.n.copy(), table.sums.copy(), table.products.copy()]
    for drive in chosen.tolist():
        rows = counts[ids[drive]].copy()
        rows[:, at] = fault.change(rows[:, at], rng)
        rounded = np.clip(np.rint(rows), -COUNT_MAX, COUNT_MAX).astype(np.int64)
        gram = Gram.from_counts(table.signals, rounded)
        for part, value in zip(parts, (gram.n, gram.sums, gram.products), strict=True):
            part[drive] = value
    return replace(cohort, tables=(GramTable(table.signals, *parts),))


def score(cohort: Cohort, report: QualityReport, chosen: Sequence[int], fault: Injected) -> Score:
    """Compare what was found with what was injected."""
    ids = cohort.drives["drive_id"].to_pylist()
    faulty = {ids[drive] for drive in chosen}
    findings = {finding.drive_id: finding.fault for finding in report.findings}
    hits = [findings[drive] for drive in faulty if drive in findings]
    right = [hit for hit in hits if set(hit.signals) & set(fault.signals)]
    return Score(
        faulty=len(faulty),
        detected=len(hits),
        right_signal=len(right),
        right_kind=sum(hit.kind in fault.kinds for hit in right),
        clean=len(ids) - len(faulty),
        false_alarms=len(findings.keys() - faulty),
    )


def main() -> None:
    root = Path(sys.argv[1])
    cohort = load_cohort(Warehouse(LocalFolder(root)))
    rng = np.random.default_rng(SEED)
    chosen = sample(cohort, rng)
    ids = cohort.drives["drive_id"].to_pylist()
    counts = read_counts(root, [ids[drive] for drive in chosen])
    clean = examine(cohort, find_wrong_labels(cohort))
    false = 1000 * len(clean.findings) / clean.drives
    print(f"{clean.drives} drives without faults, {clean.compared} compared with their peers:")
    print(f"false alarms: {len(clean.findings)}, {false:.1f} per 1,000 drives\n")
    print("| fault | found | right sensor | right kind | false alarms per 1,000 |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for fault in FAULTS:
        faulty = inject(cohort, chosen, counts, fault, rng)
        report = examine(faulty, find_wrong_labels(faulty))
        result = score(cohort, report, chosen.tolist(), fault)
        print(
            f"| {fault.name} | {result.detected / result.faulty:.0%} "
            f"| {result.right_signal / result.faulty:.0%} "
            f"| {result.right_kind / result.faulty:.0%} "
            f"| {1000 * result.false_alarms / result.clean:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
