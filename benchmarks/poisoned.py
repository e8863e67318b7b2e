"""What cars that lie do to a model, and what leaving out cars of unusual influence saves.

    python -m benchmarks.poisoned [--root DATA] [--campaign fleet] [--draws 30] [--share 0.01]

The cars are those of a campaign, six days of which are simulated into the data root first if it is
not there (a temporary one by default). In each draw two thirds of the cars train model 4
of Table I, and a share of these lies about the label: it has a gain, an offset, or the
other sign. The error is that on the other third, which is honest. "Left out" are the cars that
`select --robust` leaves out.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np

import fleet_slip
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel, fit
from tests.support.lying_cars import INPUTS, LABEL, left_out, told

DAYS = 6
TRAINING = 2 / 3
LIES: dict[str, tuple[int, float]] = {
    "none": (1, 0.0),
    "gain 2": (2, 0.0),
    "gain 10": (10, 0.0),
    "offset 0.02 rad": (1, 0.02),
    "offset 0.2 rad": (1, 0.2),
    "sign": (-1, 0.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--campaign", default="fleet")
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--share", type=float, default=0.01)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cars = grams_of_cars(given.root or Path(folder), given.campaign)
    for lie in LIES:
        print(json.dumps(measure(cars, lie, given.draws, given.share)), flush=True)


def grams_of_cars(root: Path, campaign: str) -> list[Gram]:
    """Return the Gram of each car, of the inputs and the label."""
    fleet = fleet_slip.open(root)
    fleet.simulate(campaign, days=DAYS)
    fleet.gram()
    served = load_cohort(fleet.warehouse).serving(INPUTS)
    names, number = np.unique(served.drives["vehicle_id"].to_pylist(), return_inverse=True)
    return served.table.totals(number, len(names))


def measure(cars: Sequence[Gram], lie: str, draws: int, share: float) -> dict[str, object]:
    """Return the errors on honest cars, in degrees, and who was left out."""
    plain, robust, found, falsely, honest = [], [], 0, 0, 0
    train = round(TRAINING * len(cars))
    liars = 0 if lie == "none" else max(1, round(share * train))
    for draw in range(draws):
        order = np.random.default_rng(draw).permutation(len(cars)).tolist()
        training = [
            told(cars[car], *LIES[lie]) if i < liars else cars[car]
            for i, car in enumerate(order[:train])
        ]
        test = total([cars[car] for car in order[train:]])
        plain.append(error_deg(model_of(training), test))
        out = left_out(training)
        robust.append(
            error_deg(model_of([g for i, g in enumerate(training) if i not in out]), test)
        )
        found += sum(car < liars for car in out)
        falsely += sum(car >= liars for car in out)
        honest += train - liars
    return {
        "lie": lie,
        "cars": train,
        "liars": liars,
        "draws": draws,
        "error_deg": [round(median(plain), 4), round(max(plain), 4)],
        "error_left_out_deg": [round(median(robust), 4), round(max(robust), 4)],
        "liars_found": f"{found} of {liars * draws}",
        "honest_left_out": f"{falsely} of {honest}",
    }


def total(grams: Sequence[Gram]) -> Gram:
    return sum(grams[1:], grams[0])


def model_of(grams: Sequence[Gram]) -> LinearModel:
    return fit(total(grams), INPUTS, LABEL).model


def error_deg(model: LinearModel, gram: Gram) -> float:
    """Return the root mean square error of a model over rows, in degrees."""
    sums = error_sums(model, gram)
    square = float((sums.pp - 2 * sums.py + sums.yy) / sums.n)
    return math.degrees(math.sqrt(square) * float(catalogue()[LABEL].exact_scale))


if __name__ == "__main__":
    main()
