"""Calibrated columns of Gram rows, computed exactly from the rows and the numbers of each car.

Times a number of the drive, a column has that many times the sums, and products of both numbers: no
log is read, and the numbers may be tonight's.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray
from fleet_slip.calibration.car_calibration import calibration_of
from fleet_slip.catalog.calibration_parameters import CALIBRATION
from fleet_slip.catalog.course import BESIDE, TURNED
from fleet_slip.catalog.definitions import ParameterFactor
from fleet_slip.catalog.drive_sources import ALL_DRIVES
from fleet_slip.regression.gram import GramTable, packed_position, packed_positions
from fleet_slip.warehouse.gram_reader import OpenedGrams
from fleet_slip.warehouse.gram_rows import by_signals, gram_table
from fleet_slip.warehouse.predicate import parse_predicate

# Removes what a gyroscope's bias and scale do to the Gram rows of changes, drive by drive.
#
# The label has the bias times the time, and the scale error times the angle turned, both of a
# drive: they are fitted away by z = (1, turned), P_ab − P_az P_zz⁻¹ P_zb, in whole numbers, each a
# sum of two quotients of exact numbers in binary64, rounded: the same bits everywhere. Sums are
# then zero, and products add up over drives.


def without_constant_columns(table: GramTable) -> GramTable:
    """Return the table without `BESIDE`, the turned `TURNED`, and what is constant in a drive."""
    signals = tuple(name for name in table.signals if name not in BESIDE)
    kept = [table.signals.index(name) for name in signals]
    z, n, sums = table.signals.index(TURNED), table.n.astype(object), table.sums.astype(object)
    with_z = table.products[:, [packed_position(max(i, z), min(i, z)) for i in [*kept, z]]]
    about = n[:, None] * with_z.astype(object) - sums[:, [*kept, z]] * sums[:, [z]]
    turns = np.where(about[:, -1] == 0, 1, about[:, -1])  # straight on: the others are 0 as well
    below = (n * turns).astype(np.float64)[:, None]
    means, slopes = table.sums[:, kept].astype(np.float64), about[:, :-1].astype(np.float64)
    left, right = np.tril_indices(len(kept))
    taken = means[:, left] * means[:, right] / table.n[:, None]
    taken += slopes[:, left] * slopes[:, right] / below
    products = table.products[:, list(packed_positions(tuple(kept)))]
    return GramTable(
        signals,
        table.n,
        np.zeros((len(table), len(kept)), dtype=np.int64),
        products - np.rint(taken).astype(np.int64),
    )


_SAFE = 2.0**62

CarCounts = Mapping[str, Mapping[str, int]]
"""The counts of each car's numbers, by `vehicle_id` and name."""


@dataclass(frozen=True)
class Expansion:
    """Adds a feature set's calibrated columns: each a column times one of the cars' numbers.

    `sweep`: rows are of changes, swept of the gyroscope's bias and scale.
    """

    columns: Mapping[str, tuple[str, ParameterFactor]]
    cars: CarCounts
    sweep: bool = False

    def tables(
        self, batch: pa.RecordBatch | pa.Table
    ) -> Iterator[tuple[str, GramTable, BoolArray]]:
        """Yield signals of Gram rows, their table with calibrated columns, and which these are.

        Rows of a car without a number lack the columns that need it.
        """
        for names, rows, here in by_signals(batch):
            if self.sweep:
                if TURNED not in names.split(","):
                    continue  # these drives have no change
                table = without_constant_columns(gram_table(names, rows))
            else:
                table = gram_table(names, rows)
            if not self.columns:
                yield ",".join(table.signals), table, here
                continue
            ids = rows["vehicle_id"].to_pylist()
            known = np.array(["\0".join(sorted(self.cars.get(one) or ())) for one in ids])
            at = np.flatnonzero(here)
            for kind in np.unique(known):
                chosen = known == kind
                expanded = self._expand(
                    table.take(chosen), [one for one, yes in zip(ids, chosen, strict=True) if yes]
                )
                mask = np.zeros(len(here), dtype=np.bool_)
                mask[at[chosen]] = True
                yield ",".join(expanded.signals), expanded, mask

    def _expand(self, table: GramTable, ids: list[str]) -> GramTable:
        """Return the table with the columns whose numbers are known for all of its cars."""
        known = self.cars.get(ids[0]) or {}
        added = {
            name: (of, number)
            for name, (of, number) in self.columns.items()
            if of in table.signals and number.name in known
        }
        if not added:
            return table
        factors = np.array(
            [[self.cars[one][n.name] - n.less for _, n in added.values()] for one in ids],
            dtype=np.int64,
        )
        bases = [0 if n.alone else 1 + table.signals.index(of) for of, n in added.values()]
        return expand(table, tuple(added), bases, factors)


def expand(
    table: GramTable, names: tuple[str, ...], bases: list[int], factors: NDArray[np.int64]
) -> GramTable:
    """Return a table with more columns: each is a factor of the drive times a column.

    `bases` number the columns from 1, 0 being the constant; `factors` is (drives, new). Exact.
    """
    k, new = len(table.signals), len(names)
    source = np.concatenate([table.n[:, None], table.sums, table.products], axis=1)

    def place(a: int, b: int) -> int:
        """Return where the product of two columns stands in `source`."""
        a, b = max(a, b), min(a, b)
        return a if b == 0 else 1 + k + packed_position(a - 1, b - 1)

    every = [*range(1, k + 1), *bases]
    pairs = [(k + i, j) for i in range(new) for j in range(k + i + 1)]
    at = np.array([place(every[i], every[j]) for i, j in pairs])
    ones = np.ones((len(table), k), dtype=np.int64)
    weights = np.concatenate([ones, factors], axis=1)
    left, right = (np.array(side) for side in zip(*pairs, strict=True))
    largest = np.abs(weights[:, left] * weights[:, right].astype(np.float64)) * np.abs(
        source[:, at].astype(np.float64)
    )
    if largest.size and largest.max() >= _SAFE:
        source, weights = source.astype(object), weights.astype(object)
    products: NDArray[Any] = weights[:, left] * weights[:, right] * source[:, at]
    sums = weights[:, k:] * source[:, [*bases]]
    return GramTable(
        (*table.signals, *names),
        table.n,
        np.concatenate([table.sums, sums], axis=1),
        np.concatenate([table.products, products], axis=1),
    )


def expansion_of(opened: OpenedGrams) -> Expansion:
    """Return what adds a set's calibrated columns, by the numbers of all of a car's drives now."""
    catalog = opened.catalog
    feature_set = catalog.feature_set(catalog.name_of(opened.identity))
    names, sweep = feature_set.calibrated, bool(feature_set.change_ticks)
    if not names:
        return Expansion({}, {}, sweep)
    columns = {}
    for name in names:
        number = catalog.time_columns[name].definition.number
        if number is not None:
            columns[name] = (catalog.calibrated[name].of, number)
    calibration = replace(opened, identity=catalog.identity(CALIBRATION))
    cars = calibration_of(calibration, parse_predicate(catalog.signals, ALL_DRIVES)).counts()
    return Expansion(columns, cars, sweep)
