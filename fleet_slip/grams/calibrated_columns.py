"""Calibrated columns of Gram rows: columns times a calibration parameter of each car.

A parameter is constant in a drive, so that sums and products of a calibrated column follow exactly
from those of the column. No log is read, and the parameters can be the newest.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.calibration.car_calibration import calibration_of
from fleet_slip.catalog.course import AUXILIARY, TURNED
from fleet_slip.catalog.definitions import CALIBRATION, ParameterFactor
from fleet_slip.catalog.signals import ALL_DRIVES
from fleet_slip.regression.gram import GramTable, packed_position, packed_positions
from fleet_slip.warehouse.database import parse_predicate
from fleet_slip.warehouse.gram_reader import OpenedGrams, by_signals, gram_table

# Bias and scale error of the gyroscope are removed from Gram rows of changes, drive by drive.
#
# The label contains the bias times the duration, and the scale error times the angle turned. Both
# are constant in a drive, and are projected out: with z = (1, turned), P_ab − P_az P_zz⁻¹ P_zb.
# Each correction is a sum of two quotients of exact integers in binary64, rounded to an integer, so
# that the bits are the same on every machine. Sums are zero afterwards; products add up.


def without_constant_columns(table: GramTable) -> GramTable:
    """Project the constant and `TURNED` out of the products of each drive; drop `AUXILIARY`."""
    signals = tuple(name for name in table.signals if name not in AUXILIARY)
    indices = [table.signals.index(name) for name in signals]
    z, n, sums = table.signals.index(TURNED), table.n.astype(object), table.sums.astype(object)
    with_z = table.products[:, [packed_position(max(i, z), min(i, z)) for i in [*indices, z]]]
    about = n[:, None] * with_z.astype(object) - sums[:, [*indices, z]] * sums[:, [z]]
    turns = np.where(about[:, -1] == 0, 1, about[:, -1])  # on straights the other terms are 0, too
    below = (n * turns).astype(np.float64)[:, None]
    means, slopes = table.sums[:, indices].astype(np.float64), about[:, :-1].astype(np.float64)
    row, column = np.tril_indices(len(indices))
    removed = means[:, row] * means[:, column] / table.n[:, None]
    removed += slopes[:, row] * slopes[:, column] / below
    products = table.products[:, list(packed_positions(tuple(indices)))]
    return GramTable(
        signals,
        table.n,
        np.zeros((len(table), len(indices)), dtype=np.int64),
        products - np.rint(removed).astype(np.int64),
    )


_SAFE = 2.0**62

CarCounts = Mapping[str, Mapping[str, int]]
"""Counts of the calibration parameters of each car, by `vehicle_id` and name."""


@dataclass(frozen=True)
class Expansion:
    """Adds the calibrated columns of a feature set, each a column times a parameter of the car.

    `has_changes`: bias and scale of the gyroscope are projected out of the rows first.
    """

    columns: Mapping[str, tuple[str, ParameterFactor]]
    cars: CarCounts
    has_changes: bool = False

    def tables(
        self, batch: pa.RecordBatch | pa.Table
    ) -> Iterator[tuple[str, GramTable, BoolArray]]:
        """Yield the signals of Gram rows, their table with calibrated columns, and their mask.

        Rows of a car without a parameter lack the columns that need it.
        """
        for names, rows, mask in by_signals(batch):
            if self.has_changes:
                if TURNED not in names.split(","):
                    continue  # drives without a change
                table = without_constant_columns(gram_table(names, rows))
            else:
                table = gram_table(names, rows)
            if not self.columns:
                yield ",".join(table.signals), table, mask
                continue
            cars = np.array(rows["vehicle_id"].to_pylist(), dtype=object)
            parameters = np.array(["\0".join(sorted(self.cars.get(car) or ())) for car in cars])
            positions = np.flatnonzero(mask)
            for group in np.unique(parameters):
                in_group = parameters == group
                expanded = self._expand(table.take(in_group), cars[in_group].tolist())
                group_mask = np.zeros(len(mask), dtype=np.bool_)
                group_mask[positions[in_group]] = True
                yield ",".join(expanded.signals), expanded, group_mask

    def _expand(self, table: GramTable, cars: list[str]) -> GramTable:
        """Append the columns whose parameters the cars have; all cars have the same parameters."""
        parameters = self.cars.get(cars[0]) or {}
        added = {
            name: (source, factor)
            for name, (source, factor) in self.columns.items()
            if source in table.signals and factor.name in parameters
        }
        if not added:
            return table
        factors = np.array(
            [[self.cars[car][f.name] - f.less for _, f in added.values()] for car in cars],
            dtype=np.int64,
        )
        bases = [0 if f.alone else 1 + table.signals.index(name) for name, f in added.values()]
        return expand(table, tuple(added), bases, factors)


def expand(
    table: GramTable, names: tuple[str, ...], bases: list[int], factors: NDArray[np.int64]
) -> GramTable:
    """Append columns, each a factor of the drive times a column, exactly.

    `bases` numbers the columns from 1, with 0 for the constant; `factors` has shape (drives, new).
    """
    k, new = len(table.signals), len(names)
    source = np.concatenate([table.n[:, None], table.sums, table.products], axis=1)

    def place(a: int, b: int) -> int:
        """Return the position of the product of two columns in `source`."""
        a, b = max(a, b), min(a, b)
        return a if b == 0 else 1 + k + packed_position(a - 1, b - 1)

    columns = [*range(1, k + 1), *bases]
    pairs = [(k + i, j) for i in range(new) for j in range(k + i + 1)]
    positions = np.array([place(columns[i], columns[j]) for i, j in pairs])
    ones = np.ones((len(table), k), dtype=np.int64)
    weights = np.concatenate([ones, factors], axis=1)
    row, column = (np.array(indices) for indices in zip(*pairs, strict=True))
    largest = np.abs(weights[:, row] * weights[:, column].astype(np.float64)) * np.abs(
        source[:, positions].astype(np.float64)
    )
    if largest.size and largest.max() >= _SAFE:
        source, weights = source.astype(object), weights.astype(object)
    products: NDArray[Any] = weights[:, row] * weights[:, column] * source[:, positions]
    sums = weights[:, k:] * source[:, [*bases]]
    return GramTable(
        (*table.signals, *names),
        table.n,
        np.concatenate([table.sums, sums], axis=1),
        np.concatenate([table.products, products], axis=1),
    )


def expansion_of(opened: OpenedGrams) -> Expansion:
    """Return the expansion of a feature set, by the parameters from all drives of each car."""
    catalog = opened.catalog
    feature_set = catalog.feature_set(catalog.name_of(opened.identity))
    names, has_changes = feature_set.calibrated, bool(feature_set.change_ticks)
    if not names:
        return Expansion({}, {}, has_changes)
    columns = {}
    for name in names:
        factor = catalog.time_columns[name].definition.number
        if factor is not None:
            columns[name] = (catalog.calibrated[name].of, factor)
    calibration = replace(opened, identity=catalog.identity(CALIBRATION))
    cars = calibration_of(calibration, parse_predicate(catalog.signals, ALL_DRIVES)).counts()
    return Expansion(columns, cars, has_changes)
