"""What the course of each drive comes to, from the Gram rows of any set of changes that tell it."""

from collections.abc import Mapping

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.course_relation import COLUMNS, turned_scale
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.gram_reader import GramReader
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.warehouse.condition import Condition

Moments = Mapping[str, Mapping[str, FloatArray]]
"""Sums of products of 1, `COLUMNS` and the label in SI units, by car and drive, shape (6, 6)."""


def course_moments(reader: GramReader, condition: Condition) -> Moments:
    """Return the moments of each drive that has changes of the course.

    Of the first feature set whose Gram rows are there for the whole cohort; empty without one.
    """
    for name in features().sets:
        one = features().feature_set(name)
        if one.change_ticks and set(COLUMNS) <= set(one.columns):
            try:
                opened = reader.opened(name, condition)
            except DataError:  # it has not been computed, or not for all
                continue
            found: dict[str, dict[str, FloatArray]] = {}
            for batch in opened.batches(condition):
                for names, rows, _ in by_signals(batch):
                    if not set(COLUMNS) <= set(names.split(",")):
                        continue
                    cars, drives = (rows[key].to_pylist() for key in ("vehicle_id", "drive_id"))
                    for car, drive, own in zip(
                        cars, drives, _moments(gram_table(names, rows)), strict=True
                    ):
                        of_car = found.setdefault(str(car), {})
                        of_car[drive] = of_car.get(drive, 0.0) + own
            if found:
                return found
    return {}


def _moments(table: GramTable) -> FloatArray:
    """Return the moments of each row, shape (rows, 6, 6)."""
    label = catalogue().label
    columns = (*COLUMNS, label)
    known = {name: float(scale) for name, scale in input_scales().items()}
    known |= {COLUMNS[-1]: turned_scale(), label: float(catalogue()[label].scale)}
    scales = np.array([1.0, *(known[name] for name in columns)])
    some, size = table.restrict(columns), len(columns) + 1
    full = np.empty((len(table), size, size))
    full[:, 0, 0] = some.n
    full[:, 0, 1:] = full[:, 1:, 0] = some.sums
    lower = np.tril_indices(len(columns))
    full[:, 1 + lower[0], 1 + lower[1]] = some.products
    full[:, 1 + lower[1], 1 + lower[0]] = some.products
    return np.asarray(full * np.outer(scales, scales))
