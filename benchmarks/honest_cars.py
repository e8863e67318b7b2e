"""How often `select --robust` leaves out an honest car because it drove ten times as much.

    python -m benchmarks.honest_cars ROOT [--cohort CONDITION] [--trials 40]
                                   [--cars 40] [--many 30] [--few 3]

Takes drives of one honest car, such as the sedan of `proving_ground`, for those of many: in each
trial `many` drawn by chance are one car, and `few` each the others. None of them is wrong.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import fleet_slip
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.grams.cohorts.training_folds import clustered_moments
from fleet_slip.regression.inference.influential import find_influential

SEDAN = "campaign = 'proving_ground' AND vehicle_model = 'd_class_sedan' AND lost_control_s IS NULL"


def main() -> None:
    """Print how many cars are left out of so many."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--cohort", default=SEDAN)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--cars", type=int, default=40)
    parser.add_argument("--many", type=int, default=30, help="drives of the one car")
    parser.add_argument("--few", type=int, default=3, help="drives of each other")
    asked = parser.parse_args()
    cohort = load_cohort(fleet_slip.open(asked.root).warehouse, asked.cohort)
    moments = clustered_moments(cohort.serving(cohort.inputs), "drive")
    others = asked.cars - 1
    cars = np.repeat(np.arange(asked.cars), (asked.many, *[asked.few] * others))
    many_out = others_out = 0
    for trial in range(asked.trials):
        drawn = np.random.default_rng(trial).permutation(len(moments.packed))[: len(cars)]
        found = find_influential(replace(moments, packed=moments.packed[drawn]), cars)
        named = {one.car for one in found}
        many_out += 0 in named
        others_out += len(named - {0})
    print(f"the car of {asked.many} drives: left out in {many_out} of {asked.trials} trials")
    print(f"cars of {asked.few}: {others_out} of {asked.trials * others:,}")


if __name__ == "__main__":
    main()
