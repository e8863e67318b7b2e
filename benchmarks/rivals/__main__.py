"""The paper's other systems on the test drives: networks, trees, neuro-fuzzy rules, filters.

    python -m benchmarks.rivals ROOT MODEL [--rivals mlp_8,ekf_tree] [--rows 60000]
        [--drives nominal,car_suv]

Learners are fitted to rows of the drives that the published model learned from, filters are tuned
on 24 of them. They see 2 signals, 8, or `windows`: the 8 and all columns of the model. The table
has the bytes that a car carries, the seconds of training, the microseconds of each of many
estimates, and root mean square errors in degrees: cross-validated, and on each test drive.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import fleet_slip
from benchmarks.rivals.anfis import fit_anfis
from benchmarks.rivals.inputs import Inputs, LearnedEstimate, RowSample, draw_sample
from benchmarks.rivals.learners import (
    Fit,
    fit_general_regression,
    fit_perceptron,
    fit_regression,
    fit_trees,
    one_thread,
)
from benchmarks.rivals.tree_filter import fit_tree_filter
from fleet_slip.calibration.car_calibration import calibrate
from fleet_slip.evaluation.evaluated_drives import TestDrive, simulate_drives
from fleet_slip.evaluation.evaluator import Estimator, evaluate
from fleet_slip.evaluation.filters import (
    FILTERS,
    TABLE_ONE,
    FilterEstimate,
    published_estimate,
    read_tuning_drives,
)
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from fleet_slip.models.request import load_model_list
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.scenario import load_scenario
from tests.support.catalog import CATALOG, SIGNALS

DRIVES = (
    "nominal", "noise_doubled", "melbourne", "mass_1740", "adhesion_0_7", "adhesion_0_4",
    "style_sporty", "style_limit", "biases_of_another_car", "car_suv", "imperfect",
)  # fmt: skip
TWO_SIGNALS = ("ay", "yaw_rate")
"""The inputs of the first neural network that the paper cites, [5]."""

LEARNERS: dict[str, Fit] = {
    "regression": fit_regression,
    "mlp": fit_perceptron,
    "trees": fit_trees,
    "anfis": fit_anfis,
    "grnn": fit_general_regression,
}
FILTER = next(item for item in FILTERS if item.name == "ekf_class")
TREE = "ekf_tree"
T = TypeVar("T")


class Rival(NamedTuple):
    """A trained rival, with figures beside its errors on test drives."""

    estimate: Estimator[TestDrive]
    size_bytes: int | None = None
    training_s: float | None = None
    each_us: float | None = None
    cross_validated_deg: float | None = None


def all_signals() -> tuple[str, ...]:
    """Return the signals of model 4 of Table I, which the paper settles on."""
    return next(
        item.signals for item in load_model_list(CATALOG, TABLE_ONE).model if item.name == "4"
    )


def timed(work: Callable[[], T]) -> tuple[T, float]:
    started = time.perf_counter()
    return work(), time.perf_counter() - started


def learn(fit: Fit, sample: RowSample, inputs: Inputs) -> Rival:
    """Fit and cross-validate a learner."""
    rows = sample.columns(inputs.names)
    fitted, training_s = timed(lambda: fit(rows, sample.sideslip_rad, sample.trip))
    _, many_s = timed(lambda: fitted.predict(rows[:10_000]))
    predictions = sample.cross_validated(fit, inputs.names)
    each_us = 1e6 * many_s / len(rows[:10_000])
    estimate = LearnedEstimate(inputs, fitted)
    return Rival(estimate, fitted.size_bytes, training_s, each_us, predictions.rmse_deg)


def train(
    fleet: fleet_slip.Fleet, manifest: Manifest, rows: int, is_wanted: Callable[[str], bool]
) -> Iterator[tuple[str, Rival]]:
    """Yield each rival by name."""
    yield (
        manifest.name,
        Rival(
            partial(published_estimate, SIGNALS, Predictor.from_manifest(SIGNALS, manifest)),
            8 * (len(manifest.terms) + 1),
        ),
    )
    cohort = load_cohort(fleet.warehouse, manifest.trained_on.cohort)
    windows = Inputs.of_model(manifest, all_signals())
    numbers = calibrate(fleet.warehouse).counts() if windows.plan.numbers else None
    sample = draw_sample(fleet.warehouse, cohort, windows, rows, numbers)
    sets = {"2": Inputs.of_signals(TWO_SIGNALS), "8": Inputs.of_signals(all_signals())}
    for suffix, inputs in {**sets, "windows": windows}.items():
        for name, fit in LEARNERS.items():
            if is_wanted(f"{name}_{suffix}"):
                yield f"{name}_{suffix}", learn(fit, sample, inputs)
    if not (is_wanted(FILTER.name) or is_wanted(TREE)):
        return
    car = load_scenario("nominal", SHIPPED_CONFIGS).car
    drives = read_tuning_drives(fleet.warehouse, cohort)
    with ThreadPoolExecutor(1) as executor:
        best, took_s = timed(partial(FILTER.tune, drives, car, executor))
        estimate = FilterEstimate(FILTER, best.parameters)
        yield FILTER.name, Rival(estimate, training_s=took_s)
        if is_wanted(TREE):
            tree, took_s = timed(partial(fit_tree_filter, estimate, car, drives, executor))
            yield TREE, Rival(tree, tree.size_bytes, took_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("model")
    parser.add_argument("--rivals", default="", help="by default all")
    parser.add_argument("--rows", type=int, default=60_000)
    parser.add_argument("--drives", default=",".join(DRIVES))
    arguments = parser.parse_args()
    names, rivals = arguments.drives.split(","), arguments.rivals.split(",")
    fleet = fleet_slip.open(arguments.root)
    manifest = fleet.models.get(arguments.model).manifest
    drives = simulate_drives(SIGNALS, [load_scenario(name, SHIPPED_CONFIGS) for name in names])

    def show(*cells: Any) -> None:
        texts = (
            "" if item is None else f"{item:.4g}" if isinstance(item, float) else item
            for item in cells
        )
        print("|", " | ".join(map(str, texts)), "|", flush=True)

    show("rival", "bytes", "training s", "us each", "cross-validated", *names)
    show(*["---"] * (5 + len(names)))
    with one_thread():
        for name, (estimate, *costs) in train(
            fleet, manifest, arguments.rows, lambda name: not arguments.rivals or name in rivals
        ):
            runs = evaluate(drives, {name: estimate})
            show(name, *costs, *(run.statistics[name].rmse_deg for run in runs))


if __name__ == "__main__":
    main()
