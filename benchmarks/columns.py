"""How many columns a search should take: by cross-validation, by stability, and elsewhere.

    python -m benchmarks.columns ROOT

Takes a warehouse of the campaign `fleet` with Gram rows of the feature set `windows`. Prints what
cross-validation says of models of up to 72 columns; how alike the columns are that random four
fifths of the cars choose (Jaccard); and errors of models that were chosen and fitted on one half of
the drives, on the other half.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from statistics import fmean

import numpy as np

import fleet_slip
from fleet_slip import Fleet
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.fold_sums import sum_cohort
from fleet_slip.grams.cohorts.folding import Folding, FoldKey
from fleet_slip.regression.choice.stepwise import stepwise_order
from fleet_slip.regression.choice.winner import Worth, fall_short
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.validation.folds import Folds
from fleet_slip.selection.model_list import WHOLE_SET, Search, inputs_of
from fleet_slip.selection.search import search_models

LABEL = catalogue().label
SIMULATED = "source = 'simulated'"
SIZES = (4, 8, 12, 16, 24, 32, 48, 72)
HALVES = {
    "the track waterford_hills": "track = 'waterford_hills'",
    "sedans": "vehicle_model LIKE '%sedan'",
    "adhesion below 0.75": "adhesion < 0.75",
    "speed factor below 0.88": "speed_factor < 0.88",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--most", type=int, default=max(SIZES), help="columns")
    given = parser.parse_args()
    fleet = fleet_slip.open(given.root)
    sizes = [size for size in SIZES if size <= given.most]
    cross_validated(fleet, sizes)
    inputs, folds = folds_of(fleet, SIMULATED, "vehicle", 20)
    print("| columns | " + " | ".join(map(str, sizes)) + " |")
    told = [f"{one:.2f}" for one in alike(inputs, folds.grams, sizes)]
    print(f"| alike (Jaccard) | {' | '.join(told)} |")
    for name, half in HALVES.items():
        for where, condition, others in (
            ("from", half, f"NOT ({half})"),
            ("to", f"NOT ({half})", half),
        ):
            told = [f"{error:.3f}" for error in elsewhere(fleet, condition, others, sizes)]
            print(f"| {where} {name} | {' | '.join(told)} |", flush=True)


def folds_of(fleet: Fleet, condition: str, by: FoldKey, count: int) -> tuple[Sequence[str], Folds]:
    """Return all inputs, and the folds of the drives that have them."""
    cohort = sum_cohort(fleet.warehouse, Folding(by=by, count=count), condition, "windows")
    inputs = inputs_of(cohort, WHOLE_SET)
    return inputs, cohort.folds(by, count).serving(inputs, LABEL)


def cross_validated(fleet: Fleet, sizes: Sequence[int]) -> None:
    """Print errors by number of columns, and how far each falls short of the best."""
    folding = Folding(by="drive", count=5)
    cohort = sum_cohort(fleet.warehouse, folding, SIMULATED, "windows")
    search = Search(method="exchange", most=max(sizes))
    models = search_models(cohort, inputs_of(cohort, WHOLE_SET), folding, search).models
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    print("| columns | RMSE deg | short of the best | lacks deg | condition |")
    for model in models:
        if len(model.signals) in sizes or model is best:
            short = fall_short(model, best, Worth(0.0))
            lacks = math.degrees(short.lacks)
            figures = f"{model.pooled.rmse_deg:.4f} | {short} | {lacks:.3f}"
            print(f"| {len(model.signals)} | {figures} | {model.condition_number:.2g} |")


def alike(inputs: Sequence[str], cars: Sequence[Gram], sizes: Sequence[int]) -> Iterator[float]:
    """Yield by size how alike the columns are that random four fifths of groups of cars choose."""
    rng, chosen = np.random.default_rng(0), []
    for _ in range(8):
        some = [cars[i] for i in rng.permutation(len(cars))[: len(cars) * 4 // 5]]
        total = sum(some[1:], some[0])
        chosen.append(stepwise_order(total, inputs, LABEL, "exchange", max(sizes)))
    for size in sizes:
        pairs = combinations([set(sets[size - 1]) for sets in chosen], 2)
        yield fmean(len(one & other) / len(one | other) for one, other in pairs)


def elsewhere(fleet: Fleet, condition: str, others: str, sizes: Sequence[int]) -> Iterator[float]:
    """Yield by size the error on other drives than those that a model was chosen and fitted on."""
    inputs, here = folds_of(fleet, f"{SIMULATED} AND {condition}", "drive", 5)
    _, there = folds_of(fleet, f"{SIMULATED} AND {others}", "drive", 5)
    sets = stepwise_order(here.total, inputs, LABEL, "exchange", max(sizes))
    for size in sizes:
        model = fit(here.total, sets[size - 1], LABEL).model
        yield error_sums(model, there.total).figures(input_scales()[LABEL]).rmse_deg


if __name__ == "__main__":
    main()
