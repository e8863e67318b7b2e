"""The intercept of a model that changes taught, which know none: cars that go straight do not slip.

What a car's signals are when it goes straight without lateral force follows from the offsets of its
gyroscope and accelerometer, which its drives tell without a label (`calibrate`): each signal is
fitted as a plane in both over all rows of the car, and read at these offsets. The model's columns
of such a drive, without end and even, must add up to no side-slip angle.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fleet_slip.catalogue.car_numbers import NumberName
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.drive_columns import DriveCounts
from fleet_slip.errors import DataError
from fleet_slip.grams.calibration.calibration import calibrate
from fleet_slip.grams.calibration.car_evidence import CalibratedNumber
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predictor import Predictor
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.warehouse.condition import Condition
from fleet_slip.warehouse.tables import Warehouse

OFFSETS: Mapping[str, NumberName] = {"ay": "ay_offset", "yaw_rate": "yaw_rate_offset"}
"""The signals that are off, and the numbers that tell by how much."""
ROWS = 2048
"""Ticks of the even drive: more than the shipped windows look back on."""


@dataclass(frozen=True)
class StraightOn:
    """What cars that go straight say of an intercept.

    Attributes:
        intercept: rad, the mean of the cars, each counting as often as it has rows.
        uncertainty: rad, of the mean, from the uncertainty of the cars' offsets; where that of one
            is not known, from how cars differ, and None of one car.
        spread: rad, standard deviation between cars.
        cars: how many.
    """

    intercept: float
    uncertainty: float | None
    spread: float
    cars: int


def straight_on(warehouse: Warehouse, condition: Condition, manifest: Manifest) -> StraightOn:
    """Return the intercept of a model whose manifest has none.

    Raises `DataError` if no car's drives tell the offsets of its sensors and the signals that the
    model needs.
    """
    numbers = calibrate(warehouse, condition).cars
    cohort = load_cohort(warehouse, condition, training=False)
    signals = tuple(dict.fromkeys(name for term in manifest.terms for name in term.inputs))
    predictor = Predictor.of(manifest)
    found = []
    for car, gram, facts in _by_car(cohort, tuple(dict.fromkeys((*OFFSETS, *signals)))):
        known = numbers.get(car, {})
        if set(OFFSETS.values()) <= set(known):
            found.append((gram.n, *_of_car(predictor, gram, signals, known, facts)))
    if not found:
        raise DataError(
            f"no car of {condition.text!r} tells the offsets of its sensors, which the intercept "
            f"follows from, and logs {', '.join(signals)}. Choose more drives; see fleet-slip "
            "calibrate."
        )
    rows, means, variances = np.array(found, dtype=np.float64).T
    share = rows / rows.sum()
    mean = float(share @ means)
    spread = math.sqrt(float(share @ (means - mean) ** 2))
    variance = float(share**2 @ variances)
    if math.isnan(variance):
        variance = spread**2 / len(found) if len(found) > 1 else math.nan
    uncertainty = None if math.isnan(variance) else math.sqrt(variance)
    return StraightOn(mean, uncertainty, spread, len(found))


def _by_car(cohort: Cohort, signals: Sequence[str]) -> list[tuple[str, Gram, Mapping[str, object]]]:
    """Return the sums of each car's drives that have the signals, and what is known of the car."""
    found: dict[str, tuple[Gram, Mapping[str, object]]] = {}
    first = 0
    for table in cohort.tables:
        drives = cohort.drives.slice(first, len(table))
        first += len(table)
        if not set(signals) <= set(table.signals):
            continue
        names = np.array(drives["vehicle_id"].to_pylist())
        for car in sorted(set(names.tolist())):
            gram = table.restrict(signals).total(names == car)
            row = drives.slice(int(np.argmax(names == car)), 1).to_pylist()[0]
            found[car] = (found[car][0] + gram if car in found else gram, row)
    return [(car, *found[car]) for car in sorted(found)]


def _of_car(
    predictor: Predictor,
    gram: Gram,
    signals: Sequence[str],
    known: Mapping[NumberName, CalibratedNumber],
    facts: Mapping[str, object],
) -> tuple[float, float]:
    """Return the intercept that a car asks for in rad, and its variance; NaN if not known."""
    planes = {
        name: fit(gram, tuple(OFFSETS), name).model for name in signals if name not in OFFSETS
    }
    numbers: dict[str, int] = {name: one.count for name, one in known.items()}

    def estimate(**more: float) -> float:
        at = {
            name: Fraction(known[of].value + more.get(name, 0.0)) / catalogue()[name].exact_scale
            for name, of in OFFSETS.items()
        }
        for name, plane in planes.items():
            slopes = zip(OFFSETS, plane.coefficients, strict=True)
            at[name] = plane.intercept + sum((c * at[of] for of, c in slopes), Fraction(0))
        counts = {
            name: np.full(ROWS, min(max(round(at[name]), -(2**15)), 2**15 - 1), dtype=np.int16)
            for name in signals
        }
        drive = DriveCounts(np.arange(ROWS, dtype=np.int32), counts, {}, facts, numbers)
        return float(predictor(drive)[-1])

    straight = estimate()
    if math.isnan(straight):
        raise DataError("a column of the model has no value where the car goes straight on.")
    told = [known[of].uncertainty for of in OFFSETS.values()]
    steps = [one for one in told if one is not None]
    if len(steps) < len(told):
        return -straight, math.nan
    shifts = [
        estimate(**{name: step}) - straight for name, step in zip(OFFSETS, steps, strict=True)
    ]
    return -straight, math.fsum(shift * shift for shift in shifts)
