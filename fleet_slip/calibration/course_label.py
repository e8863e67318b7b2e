"""Course of a satellite receiver as label: moments of drives, its quality, and the intercept.

A model that was learned from changes of the course lacks an intercept: a car that goes straight
does not slip.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.calibration.car_calibration import Calibration, DriveSums, calibrate, collect_sums
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import STRAIGHT, STRAIGHT_COURSE, TURNED, turned_scale
from fleet_slip.catalog.definitions import CalibrationParameterName
from fleet_slip.errors import DataError
from fleet_slip.quality.course_relation import COLUMNS
from fleet_slip.regression.exact import solve_rational
from fleet_slip.regression.gram import Gram, GramTable, packed_position
from fleet_slip.regression.least_squares import ONE, ExactSums, LinearModel, fit
from fleet_slip.warehouse.database import Predicate
from fleet_slip.warehouse.gram_reader import GramReader, by_signals, gram_table, open_grams
from fleet_slip.warehouse.warehouse import Warehouse

CourseMoments = Mapping[str, Mapping[str, FloatArray]]
"""Sums of products of 1, `COLUMNS` and the label in SI units, by car and drive, shape (6, 6)."""


def course_moments(reader: GramReader, predicate: Predicate) -> CourseMoments:
    """Return the moments of each drive of a cohort that contains changes of the course.

    Reads the first feature set of changes whose Gram rows are complete for the cohort; without one
    the result is empty.
    """
    catalog = reader.catalog
    columns = (*COLUMNS, catalog.signals.label)
    scale_of: dict[str, Fraction | float] = {**catalog.input_scales}
    scale_of[TURNED] = turned_scale(catalog.signals)
    scales = np.array([1.0, *(float(scale_of[name]) for name in columns)])
    for name in catalog.sets:
        feature_set = catalog.feature_set(name)
        if not feature_set.change_ticks or not set(COLUMNS) <= set(feature_set.columns):
            continue
        try:
            opened = reader.opened(name, predicate)
        except DataError:  # not computed, or not for all drives
            continue
        by_kind = collect_sums(opened.batches(predicate), {"course": columns}, unnamed=True)
        if sums := by_kind.get("course"):
            moments = sums.table.moments() * np.outer(scales, scales)
            return {
                car: {sums.drives[i][2]: moments[i] for i in range(rows.start, rows.stop)}
                for car, rows in sums.cars.items()
            }
    return {}


MIN_STRAIGHT_CHANGES = 100
"""Changes on straight road that the noise of the course is estimated from, at least."""
ONE_SIDED_BALANCE = 0.7
"""Turn balance beyond which ay and its square cannot be separated: 1 on a skid pad, 0.2 on a
circuit."""


@dataclass(frozen=True)
class CourseLabelQuality(Record):
    """Error of a model that was learned from changes of the course; None if not estimable.

    Attributes
    ----------
    change_s
        Durations of the changes.
    error_deg
        Cross-validated error of changes, including the noise of two fixes.
    noise_deg, noise_uncertainty_deg
        Noise of a change on straight road; jackknife over drives.
    angle_at_most_deg
        Upper bound of the error of the angle over these durations: `error_deg`
        without noise, shared by two independent errors.
    turn_balance
        Mean of the angles turned over their root mean square: 1 for constant left
        turns, -1 for constant right turns.
    """

    change_s: tuple[float, ...]
    error_deg: float
    noise_deg: float | None
    noise_uncertainty_deg: float | None
    angle_at_most_deg: float | None
    turn_balance: float

    @property
    def one_way(self) -> str | None:
        """The side of nearly all turns, or None."""
        if abs(self.turn_balance) < ONE_SIDED_BALANCE:
            return None
        return "left" if self.turn_balance > 0 else "right"


def assess_course_label(
    warehouse: Warehouse, feature_set: str, predicate: Predicate, error_deg: float
) -> CourseLabelQuality | None:
    """Assess the course as label of a model with this error; None if the set has no changes."""
    catalog = warehouse.catalog
    change_s = catalog.feature_set(feature_set).change_s
    if not change_s:
        return None
    straight: list[FloatArray] = []
    turning = np.zeros(3)
    with open_grams(warehouse, feature_set, predicate) as opened:
        for batch in opened.batches(predicate):
            for names, same, _ in by_signals(batch):
                if STRAIGHT not in names.split(","):
                    continue
                table = gram_table(names, same)
                straight.append(_straight_squares(table))
                moments = table.restrict([TURNED]).moments().sum(axis=0)
                turning += moments[[0, 0, 1], [0, 1, 1]]
    rows, turned, square = turning.tolist()
    scale = math.degrees(catalog.input_scales[catalog.signals.label])
    noise, error = _estimate_noise(np.concatenate([*straight, np.zeros((2, 0))], axis=1), scale)
    remaining = None
    if noise is not None and error is not None:  # fast cars have less noise than others
        remaining = max(0.0, error_deg**2 - max(0.0, noise - 2 * error) ** 2)
    return CourseLabelQuality(
        change_s=tuple(map(float, change_s)),
        error_deg=error_deg,
        noise_deg=noise,
        noise_uncertainty_deg=error,
        angle_at_most_deg=None if remaining is None else math.sqrt(remaining / 2),
        turn_balance=turned / math.sqrt(rows * square) if square else 0.0,
    )


def _straight_squares(table: GramTable) -> FloatArray:
    """Return degrees of freedom and squares of changes about each drive's mean, shape (2, n)."""
    at, course = table.signals.index(STRAIGHT), table.signals.index(STRAIGHT_COURSE)
    rows = table.sums[:, at].astype(np.float64)
    several = rows > 1
    square = table.products[several, packed_position(course, course)].astype(np.float64)
    mean_square = table.sums[several, course].astype(np.float64) ** 2 / rows[several]
    return np.stack([rows[several] - 1, square - mean_square])


def _estimate_noise(changes: FloatArray, scale: float) -> tuple[float | None, float | None]:
    """Return the standard deviation of changes and its standard error; None for too few."""
    rows, squares = changes
    if rows.sum() < MIN_STRAIGHT_CHANGES or len(rows) < 2:
        return None, None
    variance = float(squares.sum() / rows.sum())
    error = math.sqrt(float(((squares - variance * rows) ** 2).sum())) / float(rows.sum())
    return math.sqrt(variance) * scale, error / (2 * math.sqrt(variance)) * scale


# Intercept of a model that was learned from changes: a car that goes straight does not slip.
#
# For each car, every column of the model is fitted as a plane in curvature (r/v) and in r·v over
# all rows. Both regressors are free of the accelerometer's noise and roll. Where the car does not
# turn, the plane gives the value of the column, mostly the offset of the steering; the bias of the
# gyroscope determines that point. The intercept makes the model zero there. Road camber adds the
# same intercept to every car of a fleet. With `MIN_CARS` cars only the differences between cars
# count, and become calibrated columns of the model.

PLANE = ("curvature_mean_16", "yaw_rate_speed_mean_16")
"""Regressors of the columns of a model, beside a constant."""
OFFSET_COLUMNS: Mapping[str, CalibrationParameterName] = {
    "ay_offset_alone": "ay_offset",
    "yaw_rate_offset_alone": "yaw_rate_offset",
}
"""Calibrated columns that contain nothing but a sensor offset of the car."""
MIN_CARS = 8
"""With fewer cars all have one intercept."""
MIN_STD_RAD = math.radians(0.005)
"""Cars whose intercepts differ by less have one intercept."""
SHRINKAGE = Fraction(4, 5)
"""Share of a car's difference from the fleet that counts: the rest is chance."""
SYSTEMATIC_STD_RAD = math.radians(0.15)
"""Standard error that neither drives nor cars average out. On three real cars with 2 to 9 runs, the
intercept differs by 0.08, 0.15 and 0.3 degrees from that of a reference sensor, whose mounting
angle is as uncertain."""
GRAIN_RAD = Fraction(1, 10**9)
"""Unit of the integer intercepts that the coefficients of the offsets are fitted to."""


@dataclass(frozen=True)
class InterceptEstimate:
    """Intercept of a model and its dependence on the sensor offsets of a car.

    Attributes
    ----------
    intercept
        Rad. Mean over cars by rows; with `MIN_CARS` cars that of the median car, with
        `slopes` that of a car without offsets.
    slopes
        Rad per count of the offset, by calibrated column; empty for few or similar cars.
    uncertainty
        Rad, from the scatter of drives or cars; None for a single drive.
    std_between_cars
        Rad, what the slopes do not explain.
    cars
        Number of cars.
    """

    intercept: Fraction = Fraction(0)
    slopes: Mapping[str, Fraction] = field(default_factory=dict)
    uncertainty: float | None = None
    std_between_cars: float = 0.0
    cars: int = 0


@dataclass(frozen=True)
class _CarIntercept:
    """Intercept of one car in rad, its variance over drives, its rows and its offsets in counts."""

    value: float
    variance: float
    rows: int
    offsets: tuple[int, ...] | None


def estimate_intercept(
    warehouse: Warehouse,
    predicate: Predicate,
    feature_set: str,
    coefficients: Mapping[str, Fraction],
) -> InterceptEstimate:
    """Estimate the intercept of a model in rad from its coefficients per count of each input.

    `feature_set` contains the changes that the model was fitted to. Raises `DataError` if no drive
    determines the intercept.
    """
    catalog = warehouse.catalog
    calibration = calibrate(warehouse, predicate)
    sums = _level_sums(warehouse, predicate, feature_set, tuple(coefficients))
    estimates = [_estimate_car(catalog, sums, car, coefficients, calibration) for car in sums.cars]
    cars = [estimate for estimate in estimates if estimate is not None]
    if not cars:
        raise DataError(
            f"cannot determine the intercept: all driving of {predicate.quoted} is alike, so no "
            "sensor offset can be estimated. Choose more drives, or a model without intercept: "
            "--no-intercept."
        )
    rows, values, variances = np.array([(car.rows, car.value, car.variance) for car in cars]).T
    share = rows / rows.sum()
    mean = float(share @ values)
    std = math.sqrt(float(share @ (values - mean) ** 2))
    variance = std**2 / len(cars) if len(cars) > 1 else float(variances[0])
    error = None if math.isnan(variance) else math.hypot(math.sqrt(variance), SYSTEMATIC_STD_RAD)
    if len(cars) < MIN_CARS:
        return InterceptEstimate(Fraction(mean), {}, error, std, len(cars))
    differences = (values - float(np.median(values))) * float(SHRINKAGE)
    calibrated = np.array([car.offsets is not None for car in cars])
    offsets = np.array([car.offsets for car in cars if car.offsets is not None]).T
    model = None
    if std >= MIN_STD_RAD and calibrated.sum() >= MIN_CARS:
        model = _fit_offsets(catalog, rows[calibrated], offsets, differences[calibrated])
    if model is None:
        return InterceptEstimate(Fraction(0), {}, error, std, len(cars))
    slopes = np.array(model.coefficients, float)
    residuals = differences[calibrated] - float(model.offset) - slopes @ offsets
    squares = (residuals - residuals.mean()) ** 2
    std = math.sqrt(float(np.average(squares, weights=rows[calibrated])))
    by_offset = dict(zip(model.signals, model.coefficients, strict=True))
    return InterceptEstimate(model.intercept, by_offset, error, std, len(cars))


def intercept_columns(
    catalog: Catalog, feature_set: str, inputs: Sequence[str]
) -> tuple[str, tuple[str, ...]]:
    """Return the feature set and the columns that determine the intercept of a model of changes.

    Raises `DataError` if there is no such feature set, or it lacks a column.
    """
    base, calibrated = catalog.feature_set(feature_set).of, catalog.calibrated
    sources = (calibrated[name].of if name in calibrated else name for name in inputs)
    columns = tuple(dict.fromkeys((*PLANE, *sources)))
    available = catalog.feature_set(base).columns if base else ()
    if absent := [column for column in columns if column not in available]:
        raise DataError(
            f"the intercept needs Gram rows of {', '.join(absent)}, not only of changes: set of in "
            f"the feature set {feature_set} (configs/features.toml) to one that has them, or fit "
            "without intercept: --no-intercept."
        )
    return str(base), columns


def _level_sums(
    warehouse: Warehouse, predicate: Predicate, feature_set: str, inputs: Sequence[str]
) -> DriveSums:
    """Return the sums of the columns themselves, not of their changes, by drive."""
    base, columns = intercept_columns(warehouse.catalog, feature_set, inputs)
    with open_grams(warehouse, base, predicate) as opened:
        sums = collect_sums(opened.batches(predicate), {base: columns}, unnamed=True)
    if not sums:
        raise DataError(
            f"no drive of {predicate.quoted} has {', '.join(columns)}, which the intercept needs. "
            "Choose more drives, or fit without intercept: --no-intercept."
        )
    return sums[base]


def _estimate_car(
    catalog: Catalog,
    sums: DriveSums,
    car: str,
    coefficients: Mapping[str, Fraction],
    calibration: Calibration,
) -> _CarIntercept | None:
    """Estimate the intercept of a car; None if all its driving is alike."""
    parameters = calibration.cars.get(car, {})
    counts = {name: parameter.count for name, parameter in parameters.items()}
    weights = _weights_of_stored(catalog, coefficients, counts)
    table = sums.table.take(sums.cars[car])
    gram = table.total()
    bias, bias_error = Fraction(0), 0.0
    if gyroscope := parameters.get("yaw_rate_offset"):
        bias, bias_error = Fraction(gyroscope.value), gyroscope.uncertainty or 0.0
    means = calibration.evidence.means(car, ("slowness", "speed"))
    scales = (catalog.input_scales[name] for name in PLANE)
    # The point of the plane where the car does not turn, and its derivative by the bias.
    derivative = [Fraction(0), *(mean / scale for mean, scale in zip(means, scales, strict=True))]
    point = [Fraction(1), *(bias * component for component in derivative[1:])]
    exact = ExactSums(gram, {name: {name: Fraction(1)} for name in gram.signals})
    plane = (ONE, *PLANE)

    def evaluate(at: Sequence[Fraction]) -> float | None:
        """Return minus the model at a point of the plane; solves for both at once."""
        equations = [
            [*(exact(row, column) for column in plane), value]
            for row, value in zip(plane, at, strict=True)
        ]
        if (shares := solve_rational(equations)) is None:
            return None
        terms = (
            weight * share * exact(column, name)
            for name, weight in weights.items()
            for share, column in zip(shares, plane, strict=True)
        )
        return float(-sum(terms, Fraction(0)))

    value, value_by_bias = evaluate(point), evaluate(derivative)
    if value is None or value_by_bias is None:
        return None
    moments = table.moments()
    label = np.array([float(weights.get(name, 0)) for name in table.signals])
    variance = _jackknife_variance(
        moments[:, : len(plane), : len(plane)],
        moments[:, : len(plane), 1:] @ label,
        np.array(point, dtype=np.float64),
    )
    offsets = tuple(counts[name] for name in OFFSET_COLUMNS.values() if name in counts)
    return _CarIntercept(
        value,
        variance + (value_by_bias * bias_error) ** 2,
        gram.n,
        offsets if len(offsets) == len(OFFSET_COLUMNS) else None,
    )


def _weights_of_stored(
    catalog: Catalog,
    coefficients: Mapping[str, Fraction],
    counts: Mapping[CalibrationParameterName, int],
) -> dict[str, Fraction]:
    """Return the coefficient of each stored column for a car, whose parameters are `counts`."""
    weights: dict[str, Fraction] = {}
    for name, coefficient in coefficients.items():
        source, factor = name, 1
        if calibrated := catalog.calibrated.get(name):
            parameter = catalog.time_columns[name].definition.number
            source = calibrated.of
            if parameter:
                factor = counts.get(parameter.name, parameter.less) - parameter.less
        weights[source] = weights.get(source, Fraction(0)) + coefficient * factor
    return weights


def _jackknife_variance(inputs: FloatArray, products: FloatArray, point: FloatArray) -> float:
    """Return the variance of a plane's value at a point, by leaving out each drive.

    `inputs` are the moments of the plane's regressors of each drive, shape (drives, k, k),
    `products` those with the fitted column, (drives, k). NaN for a single drive.
    """
    drives = len(inputs)
    if drives < 2:
        return math.nan
    unit = np.sqrt(np.einsum("dii->i", inputs))
    remaining = (inputs.sum(axis=0) - inputs) / np.outer(unit, unit)
    right = (products.sum(axis=0) - products) / unit
    planes = np.einsum("dij,dj->di", np.linalg.pinv(remaining, hermitian=True), right)
    values = planes @ (point / unit)
    return float((drives - 1) / drives * ((values - values.mean()) ** 2).sum())


def _fit_offsets(
    catalog: Catalog, rows: FloatArray, offsets: FloatArray, intercepts: FloatArray
) -> LinearModel | None:
    """Fit the cars' intercepts in rad to their offsets in counts; None if offsets are collinear."""
    if not set(OFFSET_COLUMNS) <= set(catalog.calibrated):
        return None
    grains = np.rint(intercepts / float(GRAIN_RAD))
    columns = np.stack([*offsets, grains]).astype(np.int64).astype(object)
    weights = rows.astype(np.int64).astype(object)
    products = [
        int((weights * columns[i] * columns[j]).sum())
        for i in range(len(columns))
        for j in range(i + 1)
    ]
    sums = tuple(int(total) for total in (columns * weights).sum(axis=1))
    names = (*OFFSET_COLUMNS, "intercept")
    gram = Gram(names, int(weights.sum()), sums, tuple(products))
    try:
        model = fit(gram, tuple(OFFSET_COLUMNS), "intercept").model
    except DataError:
        return None
    return replace(
        model,
        coefficients=tuple(coefficient * GRAIN_RAD for coefficient in model.coefficients),
        intercept=model.intercept * GRAIN_RAD,
    )
