"""Which drives training leaves out, so that no car outweighs the others.

A car that sends Gram rows says itself how many they are of. So each counts with at most `MOST_CARS`
times the rows of the mean car, bounded likewise: with logs first, then its shortest drives, whole,
so that sums stay exact. The mean, since where most cars have sent little yet the others are no
liars. Of `BUCKETS` groups of cars, while none has more than `MOST_GROUPS` times the median's rows,
no car outweighs a sixtieth or so, and all count.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import IntArray
from fleet_slip.grams.rows.gram_rows import hash_numbers
from fleet_slip.warehouse.condition import Condition, asking
from fleet_slip.warehouse.database import sql_text

if TYPE_CHECKING:
    from fleet_slip.grams.cohorts.gram_reader import OpenedGrams

MOST_CARS = 4
MOST_GROUPS = 2
BUCKETS = 60

LEAST_CARS = 10
"""Of fewer cars the others tell little of what is usual."""


@dataclass(frozen=True)
class Outweighing:
    """The longest drives of one car, left out: the first (by rows, then name), and how many."""

    vehicle_id: str
    rows: int
    drive_id: str
    drives: int

    @property
    def condition(self) -> str:
        """SQL condition of the Gram rows that are not to count."""
        return (
            f"(source = 'received' AND vehicle_id = {sql_text(self.vehicle_id)} AND (n > "
            f"{self.rows} OR (n = {self.rows} AND drive_id >= {sql_text(self.drive_id)})))"
        )


def find_outweighing(opened: "OpenedGrams", condition: Condition) -> tuple[Outweighing, ...]:
    """Return what a cohort leaves out."""
    with asking(opened.database, condition):
        text = opened.statement("rows_of_cars.sql", condition)
        cars = opened.database.sql(text).to_arrow_table()
    if not pc.any(cars["received"]).as_py():
        return ()
    groups = _rows_of_groups(cars)
    if groups.max() <= MOST_GROUPS * np.sort(groups)[BUCKETS // 2]:
        return ()
    if len(cars) < LEAST_CARS:
        return ()
    most = most_rows(cars["n"].to_numpy())
    heavy = cars.filter(pc.and_(cars["received"], pc.greater(cars["n"], most)))
    return _left_out(opened, condition, heavy["vehicle_id"].to_pylist(), most) if heavy else ()


def most_rows(rows: IntArray) -> int:
    """Return the largest c that is not above `MOST_CARS` times the mean of min(rows, c).

    With h rows above it, c = m sum / (cars - m h); if any c holds, the largest of `rows`.
    """
    ordered: list[int] = sorted(rows.tolist())
    below, cars = sum(ordered), len(ordered)
    for heavy, largest in enumerate(reversed(ordered)):
        if cars <= MOST_CARS * heavy:
            break
        bound = MOST_CARS * below // (cars - MOST_CARS * heavy)
        if largest <= bound:
            return bound
        below -= largest
    return ordered[-1]


def _left_out(
    opened: "OpenedGrams", condition: Condition, cars: Sequence[str], most: int
) -> tuple[Outweighing, ...]:
    names = ", ".join(map(sql_text, cars))
    text = opened.statement("outweighing.sql", condition, cars=names, most=str(most))
    with asking(opened.database, condition):
        rows = opened.database.sql(text).fetchall()
    found = []
    for car, some in groupby(rows, key=lambda row: row[0]):
        beyond = [(n, drive) for _, n, drive in some]
        found.append(Outweighing(car, *beyond[0], len({drive for _, drive in beyond})))
    return tuple(found)


def _rows_of_groups(cars: pa.Table) -> IntArray:
    totals = np.zeros(BUCKETS, dtype=np.int64)
    buckets = (hash_numbers(cars["vehicle_id"].cast(pa.string())) % BUCKETS).astype(np.int64)
    np.add.at(totals, buckets, cars["n"].to_numpy())
    return totals


def drives_by_car(outweighing: Sequence[Outweighing]) -> dict[str, int]:
    """Return how many drives of each car are left out."""
    return {one.vehicle_id: one.drives for one in outweighing}
