"""The sums of a cohort over its folds, from Gram rows read batch by batch.

Comparing given models needs the Gram of each fold alone: any number of rows fits in memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.cohort_origin import CohortOrigin
from fleet_slip.grams.cohorts.expansion import Expansion, expansion_of
from fleet_slip.grams.cohorts.folding import (
    EACH,
    FOLD_KEYS,
    FoldCount,
    Folding,
    FoldKey,
    assign_folds,
    require_divided,
)
from fleet_slip.grams.cohorts.gram_cohort import empty_cohort, require_training
from fleet_slip.grams.cohorts.gram_reader import GramReader, OpenedGrams, open_grams
from fleet_slip.grams.cohorts.members import Members, received_among
from fleet_slip.grams.rows.gram_rows import Hashes, hash_numbers
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.warehouse.condition import Condition, asking, parse_cohort
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True, kw_only=True)
class SummedCohort(CohortOrigin):
    """What a selection from given models needs of a cohort.

    Attributes:
        folding, sums: how the cohort was divided, and the Gram of each fold.
        rows, drive_count: number of rows of the logs, and of drives, behind the cohort.
        members: which drives and cars the Gram rows are of.
        source: where they were read, and can be read again over other folds.
    """

    folding: Folding
    sums: CohortFolds
    rows: int
    drive_count: int
    members: Members
    source: Warehouse | GramReader

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals and features that any of the drives has, in the order of the feature set."""
        return self.inputs_among(name for grams in self.sums.tables for name in grams[0].signals)

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Return the folds; another division reads the Gram rows again, like `sum_cohort`."""
        if (by, count) == (self.folding.by, self.folding.count):
            return self.sums
        folding = Folding(by=by, count=count)
        return sum_cohort(self.source, folding, self.condition, self.feature_set).sums


def sum_cohort(
    warehouse: Warehouse | GramReader,
    folding: Folding,
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> SummedCohort:
    """Add up the Gram rows of a condition's drives over each fold.

    Raises as `fleet_slip.grams.cohorts.gram_cohort.load_cohort`, and `DataError` for one fold.
    """
    condition = parse_cohort(condition)
    require_divided(feature_set, folding.by, folding.count)
    with open_grams(warehouse, feature_set, condition) as opened:
        folds = _find_folds(opened, folding, condition)
        if folds is None:
            raise empty_cohort(warehouse, condition, feature_set)
        sums = _Sums(folds, expansion_of(opened, feature_set))
        for batch in opened.batches(condition):
            require_training(batch["source"].unique().to_pylist(), condition)
            sums.add(batch)
        origin = opened.origin(condition)
        if not sums.tables:
            raise empty_cohort(warehouse, condition, feature_set)
    members = sums.members
    return SummedCohort(
        **vars(origin),
        folding=folding,
        sums=sums.of_folds(),
        rows=sum(gram.n for grams in sums.tables.values() for gram in grams),
        drive_count=members.count_drives(members.drives),
        members=members,
        source=warehouse,
    )


@dataclass(frozen=True)
class _Folds:
    """The folds that there may be.

    Attributes:
        of_rows: tells the fold of each Gram row, from its metadata and its drive's hash.
    """

    names: Sequence[str]
    of_rows: Callable[[pa.RecordBatch, Hashes], IntArray]


def _find_folds(opened: OpenedGrams, folding: Folding, condition: Condition) -> _Folds | None:
    """Return the folds of a cohort; None of an empty one. Raises like `sum_cohort`."""
    key, dealt = FOLD_KEYS[folding.by], folding.by in ("drive", "vehicle")
    few = folding.count if dealt and folding.count != EACH else None
    text = opened.statement("cohort_sums.sql", condition)
    query = f"SELECT DISTINCT {key} FROM ({text}){f' LIMIT {few + 1}' if few else ''}"
    with asking(opened.database, condition):
        found = opened.database.sql(query).to_arrow_table()[key].combine_chunks()
    if few and len(found) > few:
        return _Folds(
            [str(fold + 1) for fold in range(few)],
            lambda rows, drives: (_dealt(rows, drives, key) % few).astype(np.int64),
        )
    if not len(found):
        return None
    assignment = assign_folds(found.to_pylist(), folding.by, folding.count)

    def fold_of(rows: pa.RecordBatch, _: Hashes) -> IntArray:
        at: IntArray = pc.index_in(rows[key].cast(found.type), value_set=found).to_numpy()
        return assignment.fold[at]

    return _Folds(assignment.names, fold_of)


def _dealt(rows: pa.RecordBatch, drives: Hashes, key: str) -> Hashes:
    """Return the hash of each Gram row's car, or of its trip, mostly that of its drive."""
    if key == "vehicle_id":
        return hash_numbers(rows[key])
    alone = pc.equal(rows["trip"], rows["drive_id"]).to_numpy(zero_copy_only=False)
    if alone.all():
        return drives
    trips = drives.copy()
    trips[~alone] = hash_numbers(rows["trip"].filter(pa.array(~alone)))
    return trips


@dataclass
class _Sums:
    """Adds up Gram rows by set of signals and fold, and remembers which drives they are of."""

    known: _Folds
    expansion: Expansion
    tables: dict[str, list[Gram]] = field(default_factory=dict)
    members: Members = field(default_factory=Members)

    def add(self, batch: pa.RecordBatch) -> None:
        """Add a batch of Gram rows."""
        drives = hash_numbers(batch["drive_id"])
        folds, came = self.known.of_rows(batch, drives), received_among(batch)
        for signals, table, here in self.expansion.tables(batch):
            self._add(signals, table, folds[here])
            cars = hash_numbers(batch["vehicle_id"].filter(pa.array(here)).unique())
            self.members.add(signals, drives[here], cars, drives[here & came])

    def _add(self, signals: str, table: GramTable, folds: IntArray) -> None:
        totals = table.totals(folds, len(self.known.names))
        before = self.tables.get(signals)
        self.tables[signals] = (
            [a + b for a, b in zip(before, totals, strict=True)] if before else totals
        )

    def of_folds(self) -> CohortFolds:
        """Return the folds that have drives. Raises `DataError` if only one has."""
        names, order = self.known.names, sorted(self.tables)
        used = [
            fold
            for fold in range(len(names))
            if any(self.tables[signals][fold].n for signals in order)
        ]
        if len(used) < 2:
            raise DataError(
                "cross-validation needs at least two folds, and the cohort has one: "
                f"{names[used[0]]}. Widen the cohort, or fold by another key."
            )
        return CohortFolds(
            tuple(names[fold] for fold in used),
            tuple(tuple(self.tables[signals][fold] for fold in used) for signals in order),
            lambda tables: self.members.count_drives([order[i] for i in tables]),
        )
