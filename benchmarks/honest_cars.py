"""How often `select --robust` leaves out an honest car because it drove ten times as much.

    python -m benchmarks.honest_cars ROOT [--cohort CONDITION] [--trials 40]

Takes drives of one honest car, such as the sedan of `proving_ground`, for those of forty: in each
trial thirty drawn by chance are one car, and three each 39 others. None of them is wrong.
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
DRIVES = (30, *[3] * 39)


def main() -> None:
    """Print how many cars are left out of so many."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--cohort", default=SEDAN)
    parser.add_argument("--trials", type=int, default=40)
    asked = parser.parse_args()
    cohort = load_cohort(fleet_slip.open(asked.root).warehouse, asked.cohort)
    moments = clustered_moments(cohort.serving(cohort.inputs), "drive")
    cars = np.repeat(np.arange(len(DRIVES)), DRIVES)
    many = others = 0
    for trial in range(asked.trials):
        drawn = np.random.default_rng(trial).permutation(len(moments.packed))[: len(cars)]
        found = find_influential(replace(moments, packed=moments.packed[drawn]), cars)
        named = {one.car for one in found}
        many += 0 in named
        others += len(named - {0})
    print(f"the car of {DRIVES[0]} drives: left out in {many} of {asked.trials} trials")
    print(f"cars of {DRIVES[1]}: {others} of {asked.trials * (len(DRIVES) - 1):,}")


if __name__ == "__main__":
    main()
