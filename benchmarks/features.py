"""What features and regimes buy: trained at low speed and tested at high speed, and the reverse.

    fleet-slip --root ROOT simulate fleet --days 3
    python -m benchmarks.features ROOT [BOUND]

Rows are divided by speed (BOUND in m/s, default 15) and drives by hash: a model is trained on the
rows of some drives on one side, and tested on the rows of the other drives on either side.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.regression.exact.figures import Figures
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.validation.crossval import held_out_errors
from fleet_slip.regression.validation.folds import CohortFolds, by_hash
from fleet_slip.selection.regimes import regime_names
from fleet_slip.warehouse.tables import Warehouse

FOLDS = 5
LABEL = catalogue().label

MODELS = {
    "raw: 3 signals": ("ax", "ay", "yaw_rate"),
    "raw: 4 signals": ("ax", "ay", "yaw_rate", "steering_wheel"),
    "raw: all signals": features().feature_set("regimes").signals,
    "curvature and ay": ("ay", "curvature"),
    "curvature, ay, ay|ay|": ("ay", "curvature", "ay_signed_square"),
    "the same and steering": (
        *("ay", "curvature", "ay_signed_square", "steer_fl", "steer_fr"),
        "steer_speed_squared",
    ),
    "signals and features": features().feature_set("regimes").inputs,
}


def sides(cohort: Cohort, bound: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each Gram row is of speeds at or above the bound."""
    regime = features().regimes["speed"]
    fast = {
        band
        for band, low in zip(regime.bands[1:], regime.bounds, strict=True)
        if float(low) >= bound
    }
    return np.array([name in fast for name in regime_names(cohort, ["speed"])])


def folds_of(cohort: Cohort, inputs: Sequence[str]) -> tuple[Gram, ...]:
    assignment = by_hash(cohort.drives["drive_id"].to_pylist(), FOLDS)
    folds = CohortFolds.of(cohort.tables, assignment, cohort.drive_numbers)
    return folds.serving(inputs, LABEL).grams


def transfer(trained: Sequence[Gram], tested: Sequence[Gram], inputs: Sequence[str]) -> Figures:
    """Train on one side without a fold, test on the other side of that fold; pool the folds."""
    total = sum(trained[1:], trained[0])
    sums = [
        held_out_errors(fit(total - mine, inputs, LABEL).model, total - mine, test)
        for mine, test in zip(trained, tested, strict=True)
    ]
    return sum(sums[1:], sums[0]).figures(input_scales()[LABEL])


def main() -> None:
    warehouse = Warehouse(LocalFolder(Path(sys.argv[1])))
    bound = float(sys.argv[2]) if len(sys.argv) > 2 else 15.0
    update_grams(warehouse)
    update_grams(warehouse, feature_set="regimes")
    cohort = load_cohort(warehouse, TRAINING_DRIVES, "regimes")
    fast = sides(cohort, bound)
    low, high = cohort.part(~fast), cohort.part(fast)
    print(f"{cohort.drive_count} drives, {low.rows:,} rows below {bound} m/s, {high.rows:,} above")
    print("held-out drives: RMSE in deg, and correlation")
    header = ("low -> low", "low -> high", "high -> high", "high -> low")
    print(f"{'':<24}" + "".join(f"{name:>18}" for name in header))
    for name, inputs in MODELS.items():
        slow, quick = folds_of(low, inputs), folds_of(high, inputs)
        cells = [
            transfer(slow, slow, inputs),
            transfer(slow, quick, inputs),
            transfer(quick, quick, inputs),
            transfer(quick, slow, inputs),
        ]
        text = "".join(f"{c.rmse_deg:>11.3f} {c.correlation:6.3f}" for c in cells)
        print(f"{name:<24}{text}")


if __name__ == "__main__":
    main()
