"""A fleet of different cars, folds by vehicle: what windows, offsets and metadata buy, and rivals.

    fleet-slip --root ROOT simulate fleet --days 7
    fleet-slip --root ROOT gram
    fleet-slip --root ROOT gram --features calibration
    fleet-slip --root ROOT gram --features fleet
    python -m benchmarks.fleet ROOT [--cohort SQL] [--calibrated-by SQL] [--no-rivals] [--json]

Every model is fitted exactly, on the drives of nine tenths of the cars, and tested on the others'.
Numbers of a car come from all its drives, the tested ones too: they need no label. With
`--calibrated-by`, from the drives of that condition only, such as those of the days before
(`--cohort "day >= '2024-06-08'" --calibrated-by "day < '2024-06-08'"`), as they are on board.

Rivals: the extended Kalman filter with the parameters of the car's class, with its true mass, and
told everything (mass, tyres, adhesion), each also without the offsets that calibrate tells, and
without a state for its accelerometer's bias; a network, boosted trees and neuro-fuzzy rules on what
the models get, on a sample of rows.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
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
from fleet_slip.regression.validation.crossval import cross_validate_inputs
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
    warehouse: Warehouse, cohort: str, found: Calibration
) -> Iterator[tuple[str, int, float, float]]:
    """Yield each model's name, number of inputs, RMSE in degrees and correlation."""
    with calibrated_by(found):
        summed = sum_cohort(warehouse, Folding(by="vehicle", count=FOLDS), cohort, SET)
    for name, inputs in models().items():
        if not set(inputs) <= set(summed.inputs):
            continue  # no car has a receiver
        one = cross_validate_inputs(
            name, summed.sums, inputs, catalogue().label, input_scales()
        ).pooled
        yield name, len(inputs), one.rmse_deg, one.correlation


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


def errors_of_filters(
    warehouse: Warehouse, cohort: str, found: Calibration
) -> Iterator[tuple[str, int, float, float]]:
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
        yield name, 0, rmse, float(np.corrcoef(truth + error, truth)[0, 1])


def errors_of_learners(
    warehouse: Warehouse, cohort: str, found: Calibration
) -> Iterator[tuple[str, int, float, float]]:
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
            yield about, len(inputs), figures.rmse_deg, figures.correlation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--cohort", default=f"{TRAINING_DRIVES} AND campaign = 'fleet'")
    parser.add_argument("--calibrated-by", default="campaign = 'fleet'")
    parser.add_argument("--no-rivals", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    warehouse = Warehouse(data_root(options.root))
    found = calibrate(warehouse, options.calibrated_by)
    if not options.json:
        print(f"{'':<48}{'inputs':>7}{'RMSE deg':>10}{'r':>8}   folds by vehicle", flush=True)
    rows = [errors_of_models(warehouse, options.cohort, found)]
    if not options.no_rivals:
        rows += [
            errors_of_learners(warehouse, options.cohort, found),
            errors_of_filters(warehouse, options.cohort, found),
        ]
    for part in rows:
        for name, inputs, rmse, correlation in part:
            if options.json:
                row = {"name": name, "inputs": inputs, "rmse_deg": rmse, "correlation": correlation}
                print(json.dumps(row), flush=True)
            else:
                shown = inputs or ""
                print(f"{name:<48}{shown:>7}{rmse:>10.4f}{correlation:>8.4f}", flush=True)


if __name__ == "__main__":
    main()
