"""A fleet of different cars, folds by vehicle: what windows, offsets and metadata buy, and rivals.

    fleet-slip --root ROOT simulate fleet --days 7
    fleet-slip --root ROOT gram
    fleet-slip --root ROOT gram --features calibration
    fleet-slip --root ROOT gram --features fleet
    python -m benchmarks.fleet ROOT [--cohort SQL] [--calibrated-by SQL] [--no-rivals] [--json]
        [--exact]

Every model is fitted exactly, on the drives of nine tenths of the cars, and tested on the others'.
Numbers of a car come from all its drives, the tested ones too: they need no label. With
`--calibrated-by`, from the drives of that condition only, such as those of the days before
(`--cohort "day >= '2024-06-08'" --calibrated-by "day < '2024-06-08'"`), as they are on board.

Rivals: the extended Kalman filter with the parameters of the car's class, with its true mass, and
told everything (mass, tyres, adhesion), each also without the offsets that calibrate tells, and
without a state for its accelerometer's bias; a network, boosted trees and neuro-fuzzy rules on what
the models get, on a sample of rows.

`--exact` simulates the cohort's days again with a label that makes no error, and judges the models
by it, too, which the label of the warehouse teaches: how far they are from the truth.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.exact_label import judge, simulate_exactly
from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import DriveSignals, read_drive
from fleet_slip.comparison.rivals.compare import all_signals, cross_validate_learner
from fleet_slip.comparison.rivals.inputs import draw_sample
from fleet_slip.comparison.rivals.learner import one_thread
from fleet_slip.comparison.rivals.learners import ANFIS, PERCEPTRON, TREES
from fleet_slip.files.data_root import data_root
from fleet_slip.grams.calibration.calibration import Calibration, calibrate
from fleet_slip.grams.cohorts import expansion, fold_sums
from fleet_slip.grams.cohorts.fold_sums import sum_cohort
from fleet_slip.grams.cohorts.folding import Folding, assign_folds
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.simulation.campaign import DriveSpec, load_campaign
from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.support.inputs_today import inputs_today

FOLDS = 10
SET = "fleet"
RUNNING = ("yaw_rate_bias", "ay_bias")
LEARNED = ("Table I, model 4", "windows", "windows, all own numbers, mass and model")
"""The models whose inputs the learned rivals get, too."""


@dataclass(frozen=True)
class Row:
    """How far off one estimator is: RMSE in degrees, against the label and the exact angle."""

    name: str
    inputs: int
    rmse_deg: float
    correlation: float
    exact_rmse_deg: float | None = None


def models() -> dict[str, tuple[str, ...]]:
    """Return the inputs of each model, by what it knows."""
    one = features().feature_set(SET)
    facts = tuple(name for name in one.windows if name in features().factors)
    windows = tuple(w for w in one.windows if w not in facts and w not in RUNNING)
    offsets = tuple(name for name in one.calibrated if "_offset_" in name)
    plain = (*one.signals, *one.features, *windows)
    slips = {name for name, column in features().calibrated.items() if "slip_" in column.number}
    own = tuple(name for name in one.calibrated if name not in slips)
    table_one = all_signals()
    return {
        "Table I, model 4": table_one,
        "windows": plain,
        "windows, running biases": (*plain, *RUNNING),
        "windows, own offsets": (*plain, *offsets),
        "windows, own offsets and other own numbers": (*plain, *own),
        "windows, own numbers, satellites' too": (*plain, *one.calibrated),
        "windows, running biases, mass and model": (*plain, *RUNNING, *facts),
        "windows, own offsets, mass and model": (*plain, *offsets, *facts),
        "windows, all own numbers, mass and model": (*plain, *own, *facts),
        "the same, satellites' numbers too": (*plain, *one.calibrated, *facts),
    }


@contextmanager
def calibrated_by(found: Calibration) -> Iterator[None]:
    """Let calibrated columns have these numbers."""
    of = expansion.expansion_of
    with patch.object(
        fold_sums,
        "expansion_of",
        lambda opened, name: replace(of(opened, name), cars=found.counts()),
    ):
        yield


def errors_of_models(
    warehouse: Warehouse, cohort: str, found: Calibration, exact: Warehouse | None
) -> Iterator[Row]:
    """Yield each model's errors, also against the label of another warehouse if there is one."""
    folding = Folding(by="vehicle", count=FOLDS)
    with calibrated_by(found):
        summed = sum_cohort(warehouse, folding, cohort, SET)
        judges = [summed.sums]
        if exact:
            judges.append(sum_cohort(exact, folding, cohort, SET).sums)
    for name, inputs in models().items():
        if not set(inputs) <= set(summed.inputs):
            continue  # no car has a receiver
        one, *others = judge(summed.sums, judges, inputs)
        against = others[0].rmse_deg if others else None
        yield Row(name, len(inputs), one.rmse_deg, one.correlation, against)


def class_car(spec: DriveSpec) -> VehicleParameters:
    return load_vehicle(spec.vehicle.name)


def car_of_true_mass(spec: DriveSpec) -> VehicleParameters:
    return class_car(spec).with_sprung_mass(spec.vehicle.body.sprung_mass_kg)


def true_car(spec: DriveSpec) -> VehicleParameters:
    """Return the very car on the very road: what friction there is, is the tyres'."""
    tyre = spec.vehicle.tyre
    on_road = tyre.model_copy(update={"friction": tyre.friction * spec.adhesion})
    return spec.vehicle.model_copy(update={"tyre": on_road})


CARS: Mapping[str, Callable[[DriveSpec], VehicleParameters]] = {
    "its class": class_car,
    "its mass": car_of_true_mass,
    "everything": true_car,
}


STATES: Mapping[str, ekf.EkfNoise] = {
    "": ekf.EkfNoise(),
    ", bias not in its state": ekf.EkfNoise(ay_bias_std_mps2=0.0),
}
"""A filter that estimates its accelerometer's bias itself needs nobody to tell it."""


def without_offsets(signals: DriveSignals, found: Calibration, car: str) -> DriveSignals:
    numbers = found.cars.get(car, {})
    yaw_rate, ay = numbers.get("yaw_rate_offset"), numbers.get("ay_offset")
    return replace(
        signals,
        yaw_rate_rad_s=signals.yaw_rate_rad_s - (yaw_rate.value if yaw_rate else 0.0),
        ay_mps2=signals.ay_mps2 - (ay.value if ay else 0.0),
    )


def errors_of_filters(warehouse: Warehouse, cohort: str, found: Calibration) -> Iterator[Row]:
    """Yield the same of the extended Kalman filter, over the rows that the models see."""
    campaign = load_campaign("fleet")
    query = f"SELECT drive_id, day FROM drives WHERE {cohort} ORDER BY drive_id"
    errors: dict[str, list[FloatArray]] = {}
    truths: list[FloatArray] = []
    with connect(warehouse.root) as database:
        chosen = database.execute(query).fetchall()
        days = {day for _, day in chosen}
        specs = {spec.drive_id: spec for day in days for spec in campaign.drives(day)}
        for drive_id, _ in chosen:
            drive, spec = read_drive(database, drive_id), specs[drive_id]
            moving = drive.signals.wheel_fl_rad_s * 0.31 >= 3
            truths.append(drive.sideslip_rad[moving])
            corrected = without_offsets(drive.signals, found, spec.vehicle_id)
            for name, make in CARS.items():
                for state, noise in STATES.items():
                    for how, signals in (("", drive.signals), (", without offsets", corrected)):
                        angle = ekf.estimate(signals, make(spec), noise)
                        error = (angle - drive.sideslip_rad)[moving]
                        errors.setdefault(f"EKF told {name}{state}{how}", []).append(error)
    truth = np.concatenate(truths)
    for name, parts in errors.items():
        error = np.concatenate(parts)
        rmse = float(np.degrees(np.sqrt(np.mean(error**2))))
        yield Row(name, 0, rmse, float(np.corrcoef(truth + error, truth)[0, 1]))


def errors_of_learners(warehouse: Warehouse, cohort: str, found: Calibration) -> Iterator[Row]:
    """Yield the same of networks, trees and neuro-fuzzy rules, on a sample of rows."""
    loaded = load_cohort(warehouse, cohort)
    sets = {name: models()[name] for name in LEARNED}
    every = inputs_today(tuple(dict.fromkeys(name for one in sets.values() for name in one)))
    sample = draw_sample(warehouse, loaded, every, numbers=found.counts())
    drives = loaded.drives.select(["trip", "vehicle_id"]).to_pylist()
    car_of = {one["trip"]: one["vehicle_id"] for one in drives}
    cars = [car_of[drive] for drive in sample.trip.tolist()]
    folds = assign_folds(cars, "vehicle", FOLDS)
    for name, inputs in sets.items():
        for learner in (PERCEPTRON, TREES, ANFIS):
            with one_thread():
                figures = cross_validate_learner(learner, sample.of(inputs), sample, folds)
            if figures.rmse_deg is None or figures.correlation is None:
                raise RuntimeError(f"{learner.name} estimates nothing")
            about = f"{learner.name}: {name}"
            yield Row(about, len(inputs), figures.rmse_deg, figures.correlation)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--cohort", default=f"{TRAINING_DRIVES} AND campaign = 'fleet'")
    parser.add_argument("--calibrated-by", default="campaign = 'fleet'")
    parser.add_argument("--no-rivals", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--exact", action="store_true")
    options = parser.parse_args()
    warehouse = Warehouse(data_root(options.root))
    given = (warehouse, options.cohort, calibrate(warehouse, options.calibrated_by))
    if not options.json:
        last = f"{'exact':>10}" if options.exact else ""
        print(f"{'':<48}{'inputs':>7}{'RMSE deg':>10}{'r':>8}{last}   folds by vehicle", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        exact = None
        if options.exact:
            exact = simulate_exactly(warehouse, options.cohort, SET, Path(folder))
        rows = [errors_of_models(*given, exact)]
        if not options.no_rivals:
            rows += [errors_of_learners(*given), errors_of_filters(*given)]
        for row in chain.from_iterable(rows):
            print(json.dumps(as_document(row)) if options.json else in_columns(row), flush=True)


def as_document(row: Row) -> dict[str, object]:
    return {name: value for name, value in vars(row).items() if value is not None}


def in_columns(row: Row) -> str:
    exact = "" if row.exact_rmse_deg is None else f"{row.exact_rmse_deg:>10.4f}"
    return f"{row.name:<48}{row.inputs or '':>7}{row.rmse_deg:>10.4f}{row.correlation:>8.4f}{exact}"


if __name__ == "__main__":
    main()
