"""Course of a satellite receiver as label: moments of each drive, and quality of such a label."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.calibration.car_calibration import collect_sums
from fleet_slip.catalog.course import STRAIGHT, STRAIGHT_COURSE, TURNED, turned_scale
from fleet_slip.errors import DataError
from fleet_slip.quality.course_relation import COLUMNS
from fleet_slip.regression.gram import GramTable, packed_position
from fleet_slip.warehouse.gram_reader import GramReader, by_signals, gram_table, open_grams
from fleet_slip.warehouse.predicate import Predicate
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
    turned = square = rows = 0.0
    with open_grams(warehouse, feature_set, predicate) as opened:
        for batch in opened.batches(predicate):
            for names, same, _ in by_signals(batch):
                if STRAIGHT not in names.split(","):
                    continue
                table = gram_table(names, same)
                straight.append(_straight_squares(table))
                at = table.signals.index(TURNED)
                turned += float(table.sums[:, at].astype(np.float64).sum())
                square += float(table.products[:, packed_position(at, at)].astype(np.float64).sum())
                rows += float(table.n.sum())
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
