"""The intercept of a model learned from changes, which have none: no car slips straight on.

A car's signals when it goes straight follow from the offsets of its gyroscope and accelerometer,
which `calibrate` tells without a label: each signal is fitted as a plane in both over all rows of
the car, and read there. From there the car is led into even bends as hard as usual, left and right
alike: on average the model must give no angle, also where an offset is squared. Cars differ mostly
by their offsets: of several cars, these become columns of the model.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from statistics import NormalDist

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.facts import NumberName
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import DriveCounts
from fleet_slip.errors import DataError
from fleet_slip.grams.calibration import calibrate
from fleet_slip.grams.car_evidence import CalibratedNumber
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel, fit
from fleet_slip.warehouse.condition import Condition
from fleet_slip.warehouse.tables import Warehouse

OFFSETS: Mapping[str, NumberName] = {"ay": "ay_offset", "yaw_rate": "yaw_rate_offset"}
"""The signals that are off, and the numbers that tell by how much."""
COLUMNS: Mapping[str, NumberName] = {
    "ay_offset_alone": "ay_offset",
    "yaw_rate_offset_alone": "yaw_rate_offset",
}
"""The calibrated columns that are a car's offsets."""
FEWEST_CARS, WORTH_RAD = 8, math.radians(0.005)
"""Fewer cars, and cars that differ by less, have one intercept."""
GRAIN_RAD = Fraction(1, 10**9)
"""Of the intercepts that the offsets' coefficients are fitted to, in whole numbers."""
ROWS = 2048
"""Ticks of an even bend: more than most shipped windows look back on."""
BENDS = tuple(NormalDist().inv_cdf((i + 0.5) / 7) for i in range(7))
"""Lateral acceleration in bends, in standard deviations."""


@dataclass(frozen=True)
class StraightOn:
    """What cars that go straight say of an intercept.

    Attributes:
        intercept: rad, the mean of cars by rows; with slopes, that of a car without offsets.
        slopes: rad for a count of the offset, by its column; none of few cars, or of like ones.
        uncertainty: rad, of the mean, from the offsets or from how cars differ; None of one.
        spread: rad, standard deviation between cars of what the slopes do not tell.
        cars: how many.
    """

    intercept: Fraction
    slopes: Mapping[str, Fraction]
    uncertainty: float | None
    spread: float
    cars: int


def straight_on(warehouse: Warehouse, condition: Condition, manifest: Manifest) -> StraightOn:
    """Return the intercept of a model without one. Raises `DataError` if no car tells offsets."""
    evidence = calibrate(warehouse, condition).evidence
    cohort = load_cohort(warehouse, condition)
    signals = tuple(dict.fromkeys(name for term in manifest.terms for name in term.inputs))
    predictor = Predictor.of(manifest)
    found = []
    for car, gram, facts in _by_car(cohort, tuple(dict.fromkeys((*OFFSETS, *signals)))):
        # Whatever part of ay is the road's: these are the roads that the model was taught on.
        known = evidence.calibrated(car, leaning=True) if car in evidence.estimates else {}
        if set(OFFSETS.values()) <= set(known):
            told = _of_car(predictor, gram, signals, known, facts)
            found.append((gram.n, *told, *(known[one].count for one in COLUMNS.values())))
    if not found:
        raise DataError(
            f"no car of {condition.text!r} tells the offsets of its sensors, which the intercept "
            f"follows from, and logs {', '.join(signals)}. Choose more drives (see fleet-slip "
            "calibrate), or a model that knows none: --no-intercept."
        )
    rows, means, variances, *offsets = np.array(found, dtype=np.float64).T
    share = rows / rows.sum()
    mean = float(share @ means)
    spread = math.sqrt(float(share @ (means - mean) ** 2))
    variance = float(share**2 @ variances)
    if math.isnan(variance):
        variance = spread**2 / len(found) if len(found) > 1 else math.nan
    uncertainty = None if math.isnan(variance) else math.sqrt(variance)
    own = None
    if len(found) >= FEWEST_CARS and spread >= WORTH_RAD:
        own = _by_offsets(rows, np.array(offsets), means)
    if own is None:
        return StraightOn(Fraction(mean), {}, uncertainty, spread, len(found))
    rest = means - float(own.offset) - np.array(own.coefficients, dtype=np.float64) @ offsets
    spread = math.sqrt(float(share @ (rest - share @ rest) ** 2))
    slopes = dict(zip(own.signals, own.coefficients, strict=True))
    return StraightOn(own.intercept, slopes, uncertainty, spread, len(found))


def _by_offsets(rows: FloatArray, offsets: FloatArray, means: FloatArray) -> LinearModel | None:
    """Fit the cars' intercepts in rad to their offsets in counts; None if these go together."""
    if not set(COLUMNS) <= set(features().calibrated):
        return None
    grains = np.rint(means / float(GRAIN_RAD))
    columns = np.stack([*offsets, grains]).astype(np.int64).astype(object)
    weights = rows.astype(np.int64).astype(object)
    products = [
        int((weights * columns[i] * columns[j]).sum())
        for i in range(len(columns))
        for j in range(i + 1)
    ]
    sums = tuple(int(total) for total in (columns * weights).sum(axis=1))
    names = (*COLUMNS, "intercept")
    gram = Gram(names, int(weights.sum()), sums, tuple(products))
    try:
        found = fit(gram, tuple(COLUMNS), "intercept").model
    except DataError:
        return None
    return replace(
        found,
        coefficients=tuple(one * GRAIN_RAD for one in found.coefficients),
        intercept=found.intercept * GRAIN_RAD,
    )


def _by_car(cohort: Cohort, signals: Sequence[str]) -> list[tuple[str, Gram, Mapping[str, object]]]:
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
    bends = {
        name: fit(gram, ("ay",), name).model.coefficients[0] for name in signals if name != "ay"
    }
    variance = gram.n * gram.products[0] - gram.sums[0] ** 2
    usual = math.sqrt(variance) / gram.n

    def estimate(bend: Sequence[float], more: Mapping[str, float]) -> float:
        at = {
            name: Fraction(known[of].value + more.get(name, 0.0)) / catalogue()[name].exact_scale
            for name, of in OFFSETS.items()
        }
        for name, plane in planes.items():
            slopes = zip(OFFSETS, plane.coefficients, strict=True)
            at[name] = plane.intercept + sum((c * at[of] for of, c in slopes), Fraction(0))
        further = usual * np.repeat(bend, ROWS)
        counts = {
            name: np.clip(
                np.rint(float(at[name]) + float(bends.get(name, 1)) * further), -(2**15), 2**15 - 1
            ).astype(np.int16)
            for name in signals
        }
        drive = DriveCounts(np.arange(len(further), dtype=np.int32), counts, {}, facts, numbers)
        return math.fsum(predictor(drive)[ROWS - 1 :: ROWS].tolist()) / len(bend)

    straight, found = estimate((0.0,), {}), estimate(BENDS, {})
    if math.isnan(found):
        raise DataError("a column of the model has no value where the car goes straight on.")
    told = [known[of].uncertainty for of in OFFSETS.values()]
    steps = [one for one in told if one is not None]
    if len(steps) < len(told):
        return -found, math.nan
    shifts = [
        estimate((0.0,), {name: step}) - straight for name, step in zip(OFFSETS, steps, strict=True)
    ]
    return -found, math.fsum(shift * shift for shift in shifts)
