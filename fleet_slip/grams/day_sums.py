"""The sums of a cohort over each day, from Gram rows that are read batch by batch."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.grams.cohort import empty_cohort_error, require_training
from fleet_slip.grams.expansion import expansion_of
from fleet_slip.grams.members import hash_numbers
from fleet_slip.grams.reader import GramReader, open_grams
from fleet_slip.regression.drive_moments import missing_signals_error
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.condition import Condition, parse_condition
from fleet_slip.warehouse.minimum_cohort import require_vehicles
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class DailySums:
    """The Gram of each day, and the number of drives in it."""

    days: tuple[date, ...]
    grams: tuple[Gram, ...]
    drives: tuple[int, ...]


def sum_days(
    source: Warehouse | GramReader,
    inputs: Sequence[str],
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> DailySums:
    """Add up, day by day, the Gram rows of the drives that have the label and all the inputs.

    Raises like `fleet_slip.grams.cohort.load_cohort`, and `DataError`
    if no drive has them all.
    """
    signals = (*inputs, catalogue().label)
    grams: dict[date, Gram] = {}
    drives: dict[date, list[NDArray[np.uint64]]] = {}
    cars: dict[date, set[str]] = {}
    found = False
    condition = parse_condition(condition)
    with open_grams(source, feature_set, condition) as opened:
        expansion = expansion_of(opened, feature_set)
        for batch in opened.batches(condition):
            found = True
            require_training(batch["source"].unique().to_pylist(), condition)
            for names, table, chosen in expansion.tables(batch):
                if not set(signals) <= set(names.split(",")):
                    continue
                rows = batch.filter(pa.array(chosen))
                here = rows["day"].dictionary_encode()
                number = here.indices.to_numpy()
                days = here.dictionary.to_pylist()
                totals = table.restrict(signals).totals(number, len(days))
                ids = hash_numbers(rows["drive_id"])
                for i, (day, total) in enumerate(zip(days, totals, strict=True)):
                    grams[day] = grams[day] + total if day in grams else total
                    drives.setdefault(day, []).append(ids[number == i])
                    mine = rows["vehicle_id"].filter(pa.array(number == i)).unique()
                    cars.setdefault(day, set()).update(mine.to_pylist())
        if not found:
            raise empty_cohort_error(opened.database, condition)
    if not grams:
        raise missing_signals_error(signals)
    days = sorted(grams)
    for day in days:
        require_vehicles(len(cars[day]), f"the cohort {condition.text!r} on {day}")
    return DailySums(
        tuple(days),
        tuple(grams[day] for day in days),
        tuple(len(np.unique(np.concatenate(drives[day]))) for day in days),
    )
