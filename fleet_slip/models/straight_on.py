"""The intercept of a model learned from changes, which have none: no car slips straight on.

Over all rows of a car each column of the model is fitted as a plane in curvature (r/v) and in
r·v, which are free of the accelerometer's noise and roll. Where the car does not turn, the
gyroscope tells its bias, and the plane what the column is there: mostly the steering's offset. The
intercept makes the model zero there. Roads that lean to one side give every car of a fleet the same
intercept, which is none: of many cars only what they differ by is taken, and becomes columns of the
model, by what `calibrate` tells of each car.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.calibration_parameters import CalibrationParameterName
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.errors import DataError
from fleet_slip.grams.calibration import Calibration, calibrate
from fleet_slip.grams.reader import DriveSums, collect_sums, open_grams
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.exact import solve_rational
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import ONE, ExactSums, LinearModel, fit
from fleet_slip.warehouse.predicate import Predicate
from fleet_slip.warehouse.warehouse import Warehouse

PLANE = ("curvature_mean_16", "yaw_rate_speed_mean_16")
"""What the columns of a model are planes in, beside a constant."""
COLUMNS: Mapping[str, CalibrationParameterName] = {
    "ay_offset_alone": "ay_offset",
    "yaw_rate_offset_alone": "yaw_rate_offset",
}
"""The calibrated columns that are a car's offsets."""
FEWEST_CARS, WORTH_RAD = 8, math.radians(0.005)
"""Fewer cars, and cars that differ by less, have one intercept."""
OWN_PART = Fraction(4, 5)
"""Of what a car's intercept differs by from the fleet's: the rest is chance."""
SHARED_RAD = math.radians(0.15)
"""Standard error that no drive and no car takes away. On three real cars, of 2 to 9 runs, the
intercept differs by 0.08, 0.15 and 0.3 degrees from that of a reference sensor, which is turned in
its car by as much."""
GRAIN_RAD = Fraction(1, 10**9)
"""Of the intercepts that the offsets' coefficients are fitted to, in whole numbers."""


@dataclass(frozen=True)
class StraightOn:
    """What cars that go straight say of an intercept.

    Attributes:
        intercept: rad, the mean of cars by rows; of a fleet that of its middle, or with slopes of a
            car without offsets.
        slopes: rad for a count of the offset, by its column; none of few cars, or of like ones.
        uncertainty: rad, from how drives or cars differ and what all share; None of one drive.
        spread: rad, standard deviation between cars of what the slopes do not tell.
        cars: how many.
    """

    intercept: Fraction
    slopes: Mapping[str, Fraction]
    uncertainty: float | None
    spread: float
    cars: int


@dataclass(frozen=True)
class _Car:
    """The intercept that a car asks for in rad, its variance as drives differ, and its rows."""

    intercept: float
    variance: float
    rows: int
    offsets: tuple[int, ...] | None


def straight_on(warehouse: Warehouse, predicate: Predicate, manifest: Manifest) -> StraightOn:
    """Return the intercept of a model without one. Raises `DataError` if no drive tells it."""
    calibration = calibrate(warehouse, predicate)
    coefficients = {
        term.signal: term.coefficient_exact * Fraction(term.scale_exact) for term in manifest.terms
    }
    sums = _levels(warehouse, predicate, manifest)
    catalog = warehouse.catalog
    every = [_of_car(catalog, sums, car, coefficients, calibration) for car in sums.cars]
    cars = [one for one in every if one is not None]
    if not cars:
        raise DataError(
            f"cannot determine the intercept: all driving of {predicate.quoted} is alike, so no "
            "sensor offset can be estimated. Choose more drives, or a model without intercept: "
            "--no-intercept."
        )
    rows, means, variances = np.array([(c.rows, c.intercept, c.variance) for c in cars]).T
    share = rows / rows.sum()
    mean = float(share @ means)
    spread = math.sqrt(float(share @ (means - mean) ** 2))
    variance = spread**2 / len(cars) if len(cars) > 1 else float(variances[0])
    unsure = None if math.isnan(variance) else math.hypot(math.sqrt(variance), SHARED_RAD)
    if len(cars) < FEWEST_CARS:
        return StraightOn(Fraction(mean), {}, unsure, spread, len(cars))
    own = (means - float(np.median(means))) * float(OWN_PART)
    known = np.array([one.offsets is not None for one in cars])
    offsets = np.array([one.offsets for one in cars if one.offsets is not None]).T
    told = None
    if spread >= WORTH_RAD and known.sum() >= FEWEST_CARS:
        told = _by_offsets(catalog, rows[known], offsets, own[known])
    if told is None:
        return StraightOn(Fraction(0), {}, unsure, spread, len(cars))
    rest = own[known] - float(told.offset) - np.array(told.coefficients, float) @ offsets
    spread = math.sqrt(float(np.average((rest - rest.mean()) ** 2, weights=rows[known])))
    slopes = dict(zip(told.signals, told.coefficients, strict=True))
    return StraightOn(told.intercept, slopes, unsure, spread, len(cars))


def levels_of(catalog: Catalog, manifest: Manifest) -> tuple[str, tuple[str, ...]]:
    """Return the set whose changes taught a model, and its columns that the intercept follows from.

    Raises `DataError` if there is no such set, or it lacks one of them.
    """
    name = catalog.name_of(manifest.trained_on.feature_set)
    base, calibrated = catalog.feature_set(name).of, catalog.calibrated
    sources = (calibrated[one].of if one in calibrated else one for one in manifest.signals)
    columns = tuple(dict.fromkeys((*PLANE, *sources)))
    available = catalog.feature_set(base).columns if base else ()
    if absent := [column for column in columns if column not in available]:
        raise DataError(
            f"the intercept needs Gram rows of {', '.join(absent)}, not only of changes: set of in "
            f"the feature set {name} (configs/features.toml) to one that has them, or fit "
            "without intercept: --no-intercept."
        )
    return str(base), columns


def _levels(warehouse: Warehouse, predicate: Predicate, manifest: Manifest) -> DriveSums:
    base, columns = levels_of(warehouse.catalog, manifest)
    with open_grams(warehouse, base, predicate) as opened:
        found = collect_sums(opened.batches(predicate), {base: columns}, unnamed=True)
    if not found:
        raise DataError(
            f"no drive of {predicate.quoted} has {', '.join(columns)}, which the intercept needs. "
            "Choose more drives, or fit without intercept: --no-intercept."
        )
    return found[base]


def _of_car(
    catalog: Catalog,
    sums: DriveSums,
    car: str,
    coefficients: Mapping[str, Fraction],
    calibration: Calibration,
) -> _Car | None:
    """Return what a car asks for; None if it drove alike all the time."""
    numbers = calibration.cars.get(car, {})
    weights = _of_columns(catalog, coefficients, {name: one.count for name, one in numbers.items()})
    table = sums.table.take(sums.cars[car])
    gram = table.total()
    bias = numbers.get("yaw_rate_offset")
    value, unsure = (Fraction(bias.value), bias.uncertainty or 0.0) if bias else (Fraction(0), 0.0)
    means = calibration.evidence.means(car, ("slowness", "speed"))
    scales = (catalog.input_scales[name] for name in PLANE)
    # Where the car does not turn, and how that moves with the gyroscope's bias.
    moved = [Fraction(0), *(mean / scale for mean, scale in zip(means, scales, strict=True))]
    point = [Fraction(1), *(value * one for one in moved[1:])]
    exact = ExactSums(gram, {name: {name: Fraction(1)} for name in gram.signals})
    plane = (ONE, *PLANE)

    def read(at: Sequence[Fraction]) -> float | None:
        """Return minus the model where the plane is read: both sides solved at once."""
        rows = [[*(exact(a, b) for b in plane), one] for a, one in zip(plane, at, strict=True)]
        if (shares := solve_rational(rows)) is None:
            return None
        parts = (
            weight * share * exact(of, name)
            for name, weight in weights.items()
            for share, of in zip(shares, plane, strict=True)
        )
        return float(-sum(parts, Fraction(0)))

    intercept, by_bias = read(point), read(moved)
    if intercept is None or by_bias is None:
        return None
    each = table.moments()
    label = np.array([float(weights.get(name, 0)) for name in table.signals])
    scatter = _scatter(
        each[:, : len(plane), : len(plane)],
        each[:, : len(plane), 1:] @ label,
        np.array(point, dtype=np.float64),
    )
    offsets = tuple(numbers[name].count for name in COLUMNS.values() if name in numbers)
    return _Car(
        intercept,
        scatter + (by_bias * unsure) ** 2,
        gram.n,
        offsets if len(offsets) == len(COLUMNS) else None,
    )


def _of_columns(
    catalog: Catalog, coefficients: Mapping[str, Fraction], numbers: Mapping[str, int]
) -> dict[str, Fraction]:
    """Return what a model of a car multiplies each stored column by; calibrated ones have none."""
    found: dict[str, Fraction] = {}
    for name, coefficient in coefficients.items():
        of, factor = name, 1
        if calibrated := catalog.calibrated.get(name):
            number = catalog.time_columns[name].definition.number
            of = calibrated.of
            factor = numbers.get(number.name, number.less) - number.less if number else 1
        found[of] = found.get(of, Fraction(0)) + coefficient * factor
    return found


def _scatter(inputs: FloatArray, products: FloatArray, point: FloatArray) -> float:
    """Return the variance of a plane's value at a point as drives differ, by leaving out each.

    `inputs` are the moments of the plane's columns of each drive, shape (drives, k, k), `products`
    those with what is fitted, (drives, k). NaN of a single drive.
    """
    drives = len(inputs)
    if drives < 2:
        return math.nan
    unit = np.sqrt(np.einsum("dii->i", inputs))
    left = (inputs.sum(axis=0) - inputs) / np.outer(unit, unit)
    right = (products.sum(axis=0) - products) / unit
    planes = np.einsum("dij,dj->di", np.linalg.pinv(left, hermitian=True), right)
    values = planes @ (point / unit)
    return float((drives - 1) / drives * ((values - values.mean()) ** 2).sum())


def _by_offsets(
    catalog: Catalog, rows: FloatArray, offsets: FloatArray, means: FloatArray
) -> LinearModel | None:
    """Fit the cars' intercepts in rad to their offsets in counts; None if these go together."""
    if not set(COLUMNS) <= set(catalog.calibrated):
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
