"""How often `fleet-slip monitor` warns of nothing, and after how many days of a growing bias.

    python -m benchmarks.drift_days ROOT [--drives 24] [--training 10] [--deals 30]
    python -m benchmarks.drift_days ROOT --in-order 30 [--cars 20] [--drives 8]

Takes a warehouse with at least 480 simulated drives and their Gram rows. Its drives are dealt to
days of 24 anew, 30 times; ten days train, the others are judged. A bias of a sensor of all
cars that grows from day to day is brought into the Gram rows themselves, which is exact: adding a
constant to a signal changes sums and products by known amounts.

With --in-order nothing is dealt: so many days of a small fleet with imperfections are simulated in
ROOT, where days have a weather, tyres wear and the same cars come back, and each window of as many
days as train, and all that follow, is judged. No day has a fault.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean, median

import numpy as np

from fleet_slip.catalogue.features import input_scales
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.monitoring.monitor import Limits
from fleet_slip.monitoring.thresholds import thresholds
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.exact.least_squares import LinearModel, fit
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.simulation_job import simulate_campaign
from fleet_slip.warehouse.tables import Warehouse

WHEELS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr")
SIGNALS = ("ax", "ay", "yaw_rate", "steering_wheel", *WHEELS)
LABEL = "sideslip"
SEED = 20180418

GROWING = {
    "ay + 0.005 m/s2 a day": ("ay", 0.005),
    "ay + 0.02 m/s2 a day": ("ay", 0.02),
    "yaw_rate + 0.0005 rad/s a day": ("yaw_rate", 0.0005),
    "steering_wheel + 0.0005 rad a day": ("steering_wheel", 0.0005),
    "steering_wheel + 0.002 rad a day": ("steering_wheel", 0.002),
    "sideslip + 0.0001 rad a day": ("sideslip", 0.0001),
}


def deals(table: GramTable, drives: int, times: int) -> Iterator[list[Gram]]:
    """Yield the sums of days of so many drives that the drives were dealt to."""
    rng = np.random.default_rng(SEED)
    days = len(table) // drives
    for _ in range(times):
        numbers = np.full(len(table), days)
        dealt = rng.permutation(len(table))[: days * drives]
        numbers[dealt] = np.repeat(np.arange(days), drives)
        yield list(table.totals(numbers, days + 1))[:days]


def biased(gram: Gram, signal: str, counts: int) -> Gram:
    """Return the Gram of the same rows with a constant added to a signal."""
    shift = [counts if name == signal else 0 for name in gram.signals]
    s, n = gram.sums, gram.n
    pairs = [(i, j) for i in range(len(shift)) for j in range(i + 1)]
    products = tuple(
        product + shift[i] * s[j] + shift[j] * s[i] + n * shift[i] * shift[j]
        for (i, j), product in zip(pairs, gram.products, strict=True)
    )
    return Gram(gram.signals, n, tuple(a + n * c for a, c in zip(s, shift, strict=True)), products)


def errors(model: LinearModel, gram: Gram) -> tuple[float, float]:
    figures = error_sums(model, gram).figures(input_scales()[LABEL])
    return figures.error_mean_deg, figures.error_std_deg


class Watch:
    """A model made of training days, and the limits that the monitor would draw."""

    def __init__(self, training: Sequence[Gram]) -> None:
        """Fit the model, and predict each training day without it."""
        total = sum(training[1:], training[0])
        self.model = fit(total, SIGNALS, LABEL).model
        usual = [errors(fit(total - day, SIGNALS, LABEL).model, day) for day in training]
        share = thresholds().monitor.false_alarms_per_day
        self.mean = Limits.of([mean for mean, _ in usual], share)
        self.std = Limits.above([std for _, std in usual], share)

    def warns(self, day: Gram) -> bool:
        mean, std = errors(self.model, day)
        return self.mean.beyond(mean) or self.std.beyond(std)


def in_order(root: Path, days: int, cars: int, drives: int) -> list[Gram]:
    """Return the sums of the days of a small fleet, simulated as they follow on each other."""
    usual = load_campaign("fleet_realistic")
    campaign = usual.model_copy(
        update={
            "name": "small_fleet",
            "number_of_days": days,
            "drives_per_day": drives,
            "plan": usual.plan.model_copy(update={"cars": cars}),
        }
    )
    warehouse = Warehouse(LocalFolder(root))
    with ThreadPoolExecutor(2) as executor:
        simulate_campaign(warehouse, campaign, campaign.days(), executor)
    update_grams(warehouse)
    served = load_cohort(warehouse, "campaign = 'small_fleet'").serving(SIGNALS)
    _, number = np.unique(served.drives["day"].to_pylist(), return_inverse=True)
    return list(served.table.totals(number.astype(np.int64), days))


def judge_in_order(days: Sequence[Gram], training: int) -> None:
    """Print how many days are warned of, by how long after the training they are."""
    pairs = [
        (later - training, watch.warns(days[first + later]))
        for first in range(len(days) - training)
        for watch in [Watch(days[first : first + training])]
        for later in range(training, len(days) - first)
    ]
    for low, high in ((0, 5), (5, 10), (10, len(days))):
        told = [warned for after, warned in pairs if low <= after < high]
        if told:
            what = f"{low + 1} to {min(high, len(days) - training)} days after"
            print(f"{what}: {sum(told)} of {len(told)} days, {1000 * fmean(told):.0f} in 1,000")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--drives", type=int, default=24, help="of a day")
    parser.add_argument("--training", type=int, default=10, help="days that train")
    parser.add_argument("--deals", type=int, default=30)
    parser.add_argument("--in-order", type=int, help="days of a small fleet, simulated")
    parser.add_argument("--cars", type=int, default=20, help="of the small fleet")
    given = parser.parse_args()
    if given.in_order:
        days = in_order(given.root, given.in_order, given.cars, given.drives)
        judge_in_order(days, given.training)
        return
    warehouse = Warehouse(LocalFolder(given.root))
    table = load_cohort(warehouse, "source = 'simulated'").serving(SIGNALS).table
    dealt = deals(table, given.drives, given.deals)
    watched = [(Watch(days[: given.training]), days[given.training :]) for days in dealt]
    warnings = [watch.warns(day) for watch, days in watched for day in days]
    print(f"{len(table)} drives; no drift: {len(warnings)} days", end=", ")
    print(f"{1000 * fmean(warnings):.1f} warnings per 1,000 days")
    print("\n| bias of all cars | median days to the first warning | longest | never |")
    print("| --- | ---: | ---: | ---: |")
    for name, (signal, per_day) in GROWING.items():
        step = per_day / float(input_scales()[signal])
        first = [
            next(
                (
                    number
                    for number, day in enumerate(days, 1)
                    if watch.warns(biased(day, signal, round(step * number)))
                ),
                None,
            )
            for watch, days in watched
        ]
        told = [number for number in first if number]
        never = f"{len(first) - len(told)} of {len(first)}"
        typical, longest = (median(told), max(told)) if told else ("-", "-")
        print(f"| {name} | {typical} | {longest} | {never} |")


if __name__ == "__main__":
    main()
