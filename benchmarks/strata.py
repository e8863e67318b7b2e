"""What weights by kind of driving buy and cost: least squares pays for the rare, so weigh it.

    python -m benchmarks.strata DATA_ROOT MODEL [--by track] [--folds 8]

Of a published model it fits the columns again to the drives that trained it, weighed by their kind:
ordinary ones, load, and bands of adhesion. Drives of the same road are left out together, fold by
fold, and each kind's error is that of drives that were left out, of roads that the fit has not
seen; the label's noise is in it. A weight of a drive is one of its Gram row.
"""

import argparse
from collections.abc import Mapping, Sequence

import numpy as np

import fleet_slip
from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.exact.gram import packed_position
from fleet_slip.vehicle.parameters import load_vehicle
from fleet_slip.warehouse.tables import Warehouse

LADEN_KG = 100.0
"""Beyond the usual mass, from which on a drive is one with load."""

KINDS = ("ordinary", "load", "wet", "slippery", "ice")
"""Dry without load and with it, adhesion of .6 to .8, of .45 to .6 and below."""

WEIGHTS: Mapping[str, Sequence[float]] = {
    "every row the same": (1, 1, 1, 1, 1),
    "ordinary ones twice": (2, 1, 1, 1, 1),
    "load three times": (1, 3, 1, 1, 1),
    "below .6 twice, below .45 four times": (1, 1, 1, 2, 4),
    "the same, load .3 times": (1, 0.3, 1, 2, 4),
}
"""Of the rows of each kind."""


@np.errstate(divide="ignore", invalid="ignore")  # of a kind of which there is no drive
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("model")
    parser.add_argument("--by", default="track", help="what folds are made of, such as drive")
    parser.add_argument("--folds", type=int, default=8)
    options = parser.parse_args()
    fleet = fleet_slip.open(options.root)
    version, divided = fleet.resolve(options.model), (options.by, options.folds)
    moments, kind, folds = drives_of(fleet.warehouse, version, *divided)
    rows = moments[:, 0, 0]
    print("| weights |", " | ".join(KINDS), "| all |")
    print("| --- " * (len(KINDS) + 2) + "|")
    plain = squared_errors(moments, folds, np.ones(len(rows)))
    size = np.bincount(kind, rows, len(KINDS))
    computed = {
        "every kind the same": 1 / size,
        "one over the kind's squared error": size / np.bincount(kind, plain, len(KINDS)),
    }
    for name, weights in {**WEIGHTS, **computed}.items():
        squares = squared_errors(moments, folds, np.asarray(weights)[kind])
        mean = [*(np.bincount(kind, squares, len(KINDS)) / size), squares.sum() / rows.sum()]
        print(f"| {name} |", " | ".join(f"{x:.3f}" for x in np.degrees(np.sqrt(mean))), "|")


def drives_of(
    warehouse: Warehouse, version: ModelVersion, by: str, count: int
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return moments of (1, inputs, label) by drive, the kind of each, and its fold.

    The label is in rad, inputs are in counts.
    """
    manifest = version.manifest
    cohort = load_cohort(
        warehouse, manifest.trained_on.cohort, manifest.trained_on.feature_set.partition("-")[0]
    )
    names = (*manifest.signals, catalogue().label)
    table, drives = cohort.tables[0].restrict(names), cohort.drives
    k = len(names)
    moments = np.empty((len(table), k + 1, k + 1))
    moments[:, 0, 0] = table.n
    moments[:, 0, 1:] = moments[:, 1:, 0] = table.sums
    at = np.array([[packed_position(i, j) for j in range(k)] for i in range(k)])
    moments[:, 1:, 1:] = table.products[:, at]
    scales = np.ones(k + 1)
    scales[-1] = float(catalogue()[names[-1]].scale)
    adhesion = drives["adhesion"].to_numpy()
    usual_kg = load_vehicle(drives["vehicle_model"][0].as_py()).body.sprung_mass_kg
    laden = drives["mass_kg"].to_numpy() > usual_kg + LADEN_KG
    kind = np.select([adhesion < 0.45, adhesion < 0.6, adhesion < 0.8, laden], [4, 3, 2, 1], 0)
    folds = assign_folds(drives[FOLD_KEYS[by]].to_pylist(), by, count)
    return moments * np.outer(scales, scales), kind, folds.fold


def squared_errors(moments: FloatArray, folds: IntArray, weights: FloatArray) -> FloatArray:
    """Return the sum of squared errors of each drive, from a fit to the other folds."""
    found = np.empty(len(folds))
    size = np.sqrt(np.einsum("gii->i", moments))
    scaled = moments / np.outer(size, size)
    for fold in np.unique(folds):
        inside = folds != fold
        total = np.einsum("g,gij->ij", weights * inside, scaled)
        theta = np.linalg.lstsq(total[:-1, :-1], total[:-1, -1], rcond=1e-13)[0]
        residual = np.append(-theta, 1.0)
        found[~inside] = np.einsum("i,gij,j->g", residual, scaled[~inside], residual)
    squares: FloatArray = found * size[-1] ** 2
    return squares


if __name__ == "__main__":
    main()
