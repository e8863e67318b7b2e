"""How good a model learned from changes of the course is, where no sensor measures the angle.

The error of changes has the noise of two fixes in it, which changes of cars that go straight on
show. These are fast, and fast cars have less of it: what is left is more than the angle's error
over the change, and each of two independent errors has half the square. What no change tells stands
beside as its cost: a late course, an antenna elsewhere.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.course_change import STRAIGHT, STRAIGHT_COURSE, TURNED, YAW_RATE
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.gram_reader import open_grams
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table
from fleet_slip.regression.exact.gram import packed_position
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.warehouse.tables import Warehouse

CURVATURE = "curvature"
LATE_S, AWAY_M = 0.01, 0.1
"""A course that is so late and an antenna that is so far from where it was said to be."""
FEWEST_STRAIGHT = 100
ONE_WAY = 0.7
"""Share of one side beyond which bends cannot be told apart: 1 on a skid pad, 0.2 on a circuit."""


@dataclass(frozen=True)
class WithoutLabel:
    """What changes of the course tell of a model's error, in degrees; None is untold.

    Attributes:
        change_s: over how long.
        error: cross-validated, of changes of the course.
        noise, noise_uncertainty: of the course, where cars go straight on; over drives.
        angle_at_most: bound of the angle's error over so long: what is left of `error`.
        late: what a course would cost that is late by `LATE_S`.
        away: what an antenna would that is `AWAY_M` from its place.
        to_the_left: mean of the angles turned over their root mean square: 1 where cars turn to
            the left alone and as hard at any time, −1 to the right.
    """

    change_s: tuple[float, ...]
    error: float
    noise: float | None
    noise_uncertainty: float | None
    angle_at_most: float | None
    late: float | None
    away: float | None
    to_the_left: float

    @property
    def one_way(self) -> str | None:
        """The side that cars turn to if they hardly ever turn to the other."""
        if abs(self.to_the_left) < ONE_WAY:
            return None
        return "left" if self.to_the_left > 0 else "right"

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        found = asdict(self)
        plain = ("change_s", "to_the_left")
        return {name if name in plain else f"{name}_deg": one for name, one in found.items()}


def without_label(warehouse: Warehouse, cohort: CohortOrigin, error: float) -> WithoutLabel | None:
    """Return how good a model of such an error in degrees is; None unless changes taught it."""
    times = features().feature_set(cohort.feature_set).change_s
    if not times:
        return None
    noise = _Noise()
    squares = {YAW_RATE: [0.0, 0.0], CURVATURE: [0.0, 0.0], TURNED: [0.0, 0.0]}
    turned = 0.0
    with open_grams(warehouse, cohort.feature_set, cohort.condition) as opened:
        for batch in opened.batches(cohort.condition):
            for names, rows, _ in by_signals(batch):
                if STRAIGHT not in names.split(","):
                    continue
                table = gram_table(names, rows)
                noise.add(table)
                _add_squares(squares, table)
                turned += float(table.sums[:, table.signals.index(TURNED)].astype(np.float64).sum())
    scale = math.degrees(input_scales()[catalogue().label])
    spread = {
        name: math.sqrt(square / rows) * float(input_scales()[name]) if rows else None
        for name, (square, rows) in squares.items()
        if name in input_scales()
    }
    square, rows = squares[TURNED]
    own, unsure = noise.told(float(scale)) or (None, None)
    left = None if own is None else max(0.0, error**2 - max(0.0, own - 2 * (unsure or 0.0)) ** 2)
    rate, away = spread[YAW_RATE], spread[CURVATURE]
    return WithoutLabel(
        change_s=tuple(float(one) for one in times),
        error=error,
        noise=own,
        noise_uncertainty=unsure,
        angle_at_most=None if left is None else math.sqrt(left / 2),
        late=None if rate is None else math.degrees(LATE_S * rate),
        away=None if away is None else math.degrees(AWAY_M * away),
        to_the_left=turned / math.sqrt(rows * square) if square else 0.0,
    )


class _Noise:
    """Adds up the changes of drives where they go straight on, about their mean in each drive."""

    def __init__(self) -> None:
        self.rows: list[FloatArray] = []
        self.squares: list[FloatArray] = []

    def add(self, table: GramTable) -> None:
        at, course = table.signals.index(STRAIGHT), table.signals.index(STRAIGHT_COURSE)
        rows = table.sums[:, at].astype(np.float64)
        some = rows > 1
        square = table.products[some, packed_position(course, course)].astype(np.float64)
        self.rows.append(rows[some] - 1)
        self.squares.append(square - table.sums[some, course].astype(np.float64) ** 2 / rows[some])

    def told(self, scale: float) -> tuple[float, float] | None:
        """Return the standard deviation of changes and its standard error; None of few."""
        rows, squares = (
            np.concatenate([*parts, np.zeros(0)]) for parts in (self.rows, self.squares)
        )
        if rows.sum() < FEWEST_STRAIGHT or len(rows) < 2:
            return None
        variance = float(squares.sum() / rows.sum())
        error = math.sqrt(float(((squares - variance * rows) ** 2).sum())) / float(rows.sum())
        return math.sqrt(variance) * scale, error / (2 * math.sqrt(variance)) * scale


def _add_squares(squares: dict[str, list[float]], table: GramTable) -> None:
    """Add the squares of what columns change by, in counts, and the rows that they are of."""
    for name, found in squares.items():
        if name in table.signals:
            at = table.signals.index(name)
            found[0] += float(table.products[:, packed_position(at, at)].astype(np.float64).sum())
            found[1] += float(table.n.sum())
