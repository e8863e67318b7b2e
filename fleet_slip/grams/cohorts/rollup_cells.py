"""The cells of rollups that are in a cohort, which stand in for the Gram rows of their files.

A rollup serves where its columns tell condition and folds of all rows, to the bit of the rows'
sums; other files' rows are read.
"""

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.sources import RECEIVED, RECEIVED_FILES
from fleet_slip.delta import Snapshot
from fleet_slip.grams.cohorts.folding import EACH, FOLD_KEYS, Folding
from fleet_slip.grams.cohorts.members import Hashed
from fleet_slip.grams.rows.rollup import (
    BUCKET_KEYS,
    BUCKETS,
    FileDrives,
    Hashes,
    Rollup,
    hash_numbers,
    read_rollup,
)
from fleet_slip.warehouse.condition import Condition, asking
from fleet_slip.warehouse.database import open_database
from fleet_slip.warehouse.table_views import add_table

READS_AT_ONCE = 16


@dataclass(frozen=True)
class Cells:
    """A cohort's cells, a row each; `rollup` is a place among those serving, with cells or not."""

    table: pa.Table
    rollups: Sequence[Rollup] = ()

    @property
    def paths(self) -> frozenset[str]:
        """The Gram files whose rows need not be read."""
        return frozenset(one.path for one in self.rollups)

    def dealt(self, key: str) -> pa.Table:
        """Return the cells of one deal into buckets, by drive or by vehicle: each has all rows."""
        return self.table.filter(pc.equal(self.table["key"], key))

    def by(self, *columns: str) -> Iterator[tuple[tuple[Any, ...], pa.Table]]:
        """Yield the values of some columns, and the cells dealt by drive that have them."""
        if not len(self.table):
            return
        cells = self.dealt("drive")
        values = list(zip(*(cells[name].to_pylist() for name in columns), strict=True))
        number = {value: i for i, value in enumerate(dict.fromkeys(values))}
        of_cell = np.array([number[value] for value in values])
        for value, i in number.items():
            yield value, cells.filter(pa.array(of_cell == i))

    def drives(self, cells: pa.Table) -> Hashed:
        """Return the drives of some cells dealt by drive, of the same signals."""
        some = cells.select(["rollup", "first_drive", "gram_rows"])
        parts = tuple(
            FileDrives(self.rollups[place], some.filter(pc.equal(some["rollup"], place)))
            for place in some["rollup"].unique().to_pylist()
        )
        return Hashed(parts, once=pc.sum(cells["gram_rows"]).as_py())

    def vehicles(self, cells: pa.Table) -> Hashed:
        """Return the cars of some cells dealt by drive."""

        def part(place: int) -> Hashes:
            return self.rollups[place].vehicles(cells.filter(pc.equal(cells["rollup"], place)))

        parts = tuple(partial(part, place) for place in cells["rollup"].unique().to_pylist())
        return Hashed(parts)

    def received(self, cells: pa.Table) -> Hashed | None:
        """Return the drives of some cells whose cars sent them; None if there are none."""
        came = cells.filter(pc.fill_null(pc.equal(cells["source"], RECEIVED), False))
        return self.drives(came) if len(came) else None

    def tell_more_than(self, folds: int, key: str) -> bool:
        """Whether the cells alone tell that there are more drives, or cars, than folds."""
        cells, many = self.dealt(key), "gram_rows" if key == "drive" else "cars"
        alike = ["signals"] if key == "drive" else ["signals", "rollup"]
        sums = cells.group_by(alike).aggregate([(many, "sum")])[f"{many}_sum"]
        return int(pc.max(sums).as_py()) > folds


NO_CELLS = Cells(pa.table({"key": pa.nulls(0, pa.string())}))  # pa.array would import pandas


def dealt_folds(folding: Folding) -> int | None:
    """Return the folds that drives or cars are dealt into, None if no bucket tells them."""
    return None if folding.by not in BUCKET_KEYS or folding.count == EACH else folding.count


class RollupReader:
    """Reads rollups, each once."""

    def __init__(self) -> None:
        self._known: dict[str, Rollup | None] = {}

    def cells(
        self,
        grams: Snapshot,
        logs: Snapshot,
        identity: str,
        condition: Condition,
        folding: Folding,
        revoked: Collection[str] = (),
    ) -> Cells:
        """Return the cells of a cohort, but of `revoked` cars; none if its rows must be read."""
        wanted = condition.columns
        if folding.by not in BUCKET_KEYS:
            wanted |= {FOLD_KEYS[folding.by]}
        elif folding.count == EACH or BUCKETS % folding.count:
            return NO_CELLS
        barred = hash_numbers(pa.array(sorted(revoked), pa.string()))
        active = {file.path for file in logs.files}
        serving = [
            one
            for one in self._rollups(grams)
            if one.feature_set == identity
            and wanted <= one.by
            and all(file in active or file.startswith(RECEIVED_FILES) for file in one.files)
            and not (len(barred) and np.isin(barred, one.vehicles()).any())
        ]
        if not serving:
            return NO_CELLS
        cells = Cells(_chosen(serving, sorted(wanted), condition), serving)
        folds = dealt_folds(folding)
        if folds and len(cells.table) and not cells.tell_more_than(folds, folding.by):
            return NO_CELLS
        return cells

    def _rollups(self, grams: Snapshot) -> list[Rollup]:
        paths = [file.path for file in grams.files]
        unread = [path for path in paths if path not in self._known]
        with ThreadPoolExecutor(READS_AT_ONCE) as executor:  # a store answers many as fast as one
            found = executor.map(partial(read_rollup, grams.table), unread)
            known = self._known | dict(zip(unread, found, strict=True))
        self._known = {path: known[path] for path in paths}
        return [one for one in self._known.values() if one]


def _chosen(rollups: Sequence[Rollup], wanted: Sequence[str], condition: Condition) -> pa.Table:
    kept = dict.fromkeys([*Rollup.COUNTS, "source", "day", "signals", *wanted])
    every = pa.concat_tables(
        one.cells.select([*kept, "n", "sums", "products"])
        .replace_schema_metadata()
        .append_column("rollup", pa.repeat(place, len(one.cells)))
        for place, one in enumerate(rollups)
    )
    number = pa.array(np.arange(len(every)))
    with open_database() as database, asking(database, condition):
        add_table(database, "cell", every.select(wanted).append_column("cell_number", number))
        query = f"SELECT cell_number FROM cell WHERE {condition.sql} ORDER BY ALL"
        places = database.sql(query).to_arrow_table()["cell_number"]
    return every.take(places).combine_chunks()
