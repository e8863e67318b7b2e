"""The sums of a cohort over its folds, from Gram rows that are read batch by batch.

Comparing given models needs no single drive, only the Gram of each fold. So any number of Gram
rows is added up in the memory of one batch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import (
    assign_folds,
    empty_cohort_error,
    gram_condition,
    require_divided,
    require_training,
)
from fleet_slip.grams.expansion import Expansion, expansion_of
from fleet_slip.grams.folding import (
    FOLD_KEYS,
    FoldCount,
    Folding,
    FoldKey,
)
from fleet_slip.grams.members import Members, hash_numbers, received_among
from fleet_slip.grams.reader import GramReader, OpenedGrams, open_grams
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.gram import Gram
from fleet_slip.warehouse.condition import Condition, asking, parse_condition
from fleet_slip.warehouse.minimum_cohort import require_vehicles
from fleet_slip.warehouse.tables import Warehouse

FoldOf = Callable[[pa.RecordBatch, NDArray[np.uint64]], IntArray]
"""Tells the fold of each Gram row, from its metadata and its drive's hash."""


@dataclass(frozen=True)
class SummedCohort:
    """What a selection from given models needs of a cohort; see `fleet_slip.grams.cohort.Cohort`.

    Attributes:
        condition: which drives, by the columns of the view `drives`.
        folding: how the cohort was divided.
        sums: the Gram of each fold.
        rows, drive_count: number of rows of the logs, and of drives, behind the cohort.
        logs_version, grams_version: versions of the Delta tables that were read.
        members: which drives and cars the Gram rows are of.
        source: where they were read, and can be read again over other folds.
        feature_set: which Gram rows were read.
        left_out: drives of the condition that have no such Gram rows: their cars sent no log.
        revoked: how many drives of a car are left out, since a revoked key signed them.
    """

    condition: Condition
    folding: Folding
    sums: CohortFolds
    rows: int
    drive_count: int
    logs_version: int
    grams_version: int
    members: Members
    source: Warehouse | GramReader
    feature_set: str = PLAIN
    left_out: int = 0
    revoked: Mapping[str, int] = field(default_factory=dict)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals and features that any of the drives has, in the order of the feature set."""
        found = {name for grams in self.sums.tables for name in grams[0].signals}
        return tuple(
            name for name in features().feature_set(self.feature_set).inputs if name in found
        )

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Return the folds; for others than the cohort was read over, its Gram rows as of now.

        Raises what `sum_cohort` raises.
        """
        if (by, count) == (self.folding.by, self.folding.count):
            return self.sums
        folding = Folding(by=by, count=count)
        return sum_cohort(self.source, folding, self.condition, self.feature_set).sums

    def gram_condition(self, inputs: Sequence[str]) -> str:
        """Return the SQL condition on the view `grams` of the rows that a model is made of."""
        return gram_condition(self.condition, self.feature_set, inputs)


def sum_cohort(
    warehouse: Warehouse | GramReader,
    folding: Folding,
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> SummedCohort:
    """Add up the Gram rows of the drives that satisfy a condition, over each fold.

    Raises like `fleet_slip.grams.cohort.load_cohort`, and `DataError`
    if there are not two folds.
    """
    condition = parse_condition(condition)
    require_divided(feature_set, folding.by, folding.count)
    with open_grams(warehouse, feature_set, condition) as opened:
        names, fold_of = _folding(opened, folding, condition)
        sums = _Sums(len(names), fold_of, expansion_of(opened, feature_set))
        for batch in opened.batches(condition):
            require_training(batch["source"].unique().to_pylist(), condition)
            sums.add(batch)
        left_out, revoked = opened.count_left_out(condition), opened.revoked(condition)
        if not sums.tables:
            raise empty_cohort_error(opened.database, condition, left_out)
    for signals, hashes in sums.members.vehicles.items():
        of = f"the cohort {condition.text!r} with the signals {signals}"
        require_vehicles(len(np.unique(hashes)), of)
    return SummedCohort(
        condition=condition,
        folding=folding,
        sums=sums.folds(names),
        rows=sum(gram.n for grams in sums.tables.values() for gram in grams),
        drive_count=sums.drive_count,
        logs_version=opened.logs_version,
        grams_version=opened.grams_version,
        members=sums.members,
        source=warehouse,
        feature_set=feature_set,
        left_out=left_out,
        revoked=revoked,
    )


def _folding(
    opened: OpenedGrams, folding: Folding, condition: Condition
) -> tuple[list[str], FoldOf]:
    """Return the names of all folds that there may be, and what tells the fold of a Gram row."""
    count = folding.count
    few = count if folding.by == "drive" and isinstance(count, int) else None
    key = FOLD_KEYS[folding.by]
    text = opened.statement("cohort_sums.sql", condition)
    query = f"SELECT DISTINCT {key} FROM ({text}){f' LIMIT {few + 1}' if few else ''}"
    with asking(opened.database, condition):
        found = opened.database.sql(query).to_arrow_table()
    if few and len(found) > few:
        names = [str(fold + 1) for fold in range(few)]
        return names, lambda batch, drives: (_trips(batch, drives) % few).astype(np.int64)
    values = found[key].combine_chunks()
    if not len(values):
        raise empty_cohort_error(opened.database, condition, opened.count_left_out(condition))
    assignment = assign_folds(values.to_pylist(), folding.by, folding.count)

    def fold_of(batch: pa.RecordBatch, _: NDArray[np.uint64]) -> IntArray:
        at: IntArray = pc.index_in(batch[key], value_set=values).to_numpy()
        return assignment.fold[at]

    return list(assignment.names), fold_of


def _trips(batch: pa.RecordBatch, drives: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the hash of each Gram row's trip, mostly that of its drive."""
    alone = pc.equal(batch["trip"], batch["drive_id"]).to_numpy(zero_copy_only=False)
    if alone.all():
        return drives
    trips = drives.copy()
    trips[~alone] = hash_numbers(batch["trip"].filter(pa.array(~alone)))
    return trips


@dataclass
class _Sums:
    """Adds up Gram rows by set of signals and fold, and remembers which drives they are of."""

    count: int
    fold_of: FoldOf
    expansion: Expansion
    tables: dict[str, list[Gram]] = field(default_factory=dict)
    drives: dict[str, list[NDArray[np.uint64]]] = field(default_factory=dict)
    vehicles: dict[str, list[NDArray[np.uint64]]] = field(default_factory=dict)
    received: dict[str, list[NDArray[np.uint64]]] = field(default_factory=dict)
    used: set[int] = field(default_factory=set)
    divided: bool = False
    """Whether a drive may have several Gram rows of the same signals."""

    def add(self, batch: pa.RecordBatch) -> None:
        """Add a batch of Gram rows."""
        drives = hash_numbers(batch["drive_id"])
        folds, came = self.fold_of(batch, drives), received_among(batch)
        self.used.update(np.unique(folds).tolist())
        self.divided |= batch["part"].null_count < len(batch)
        for signals, table, here in self.expansion.tables(batch):
            totals = table.totals(folds[here], self.count)
            known = self.tables.get(signals)
            self.tables[signals] = (
                [a + b for a, b in zip(known, totals, strict=True)] if known else totals
            )
            self.drives.setdefault(signals, []).append(drives[here])
            cars = hash_numbers(batch["vehicle_id"].filter(pa.array(here)).unique())
            self.vehicles.setdefault(signals, []).append(cars)
            self.received.setdefault(signals, []).append(drives[here & came])

    @property
    def _one_each(self) -> bool:
        """Whether every Gram row is of a drive of its own: then nothing must be sorted to tell."""
        return len(self.tables) == 1 and not self.divided

    @property
    def members(self) -> Members:
        """Which drives and cars the Gram rows are of."""
        drives = {signals: np.concatenate(parts) for signals, parts in self.drives.items()}
        cars = {signals: np.concatenate(parts) for signals, parts in self.vehicles.items()}
        came = {signals: np.concatenate(parts) for signals, parts in self.received.items()}
        return Members(drives, cars, came)

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        every = [part for parts in self.drives.values() for part in parts]
        return sum(map(len, every)) if self._one_each else len(np.unique(np.concatenate(every)))

    def folds(self, names: Sequence[str]) -> CohortFolds:
        """Return the folds that a drive fell into. Raises `DataError` if it is one only."""
        used = sorted(self.used)
        if len(used) < 2:
            raise DataError(
                "cross-validation needs at least two folds, and the cohort has one: "
                f"{names[used[0]]}. Widen the cohort, or fold by another key."
            )
        order = sorted(self.tables)
        return CohortFolds(
            tuple(names[fold] for fold in used),
            tuple(tuple(self.tables[signals][fold] for fold in used) for signals in order),
            self._numbers(order),
        )

    def _numbers(self, order: Sequence[str]) -> tuple[IntArray, ...]:
        """Return the number of each Gram row's drive, table by table."""
        if self._one_each:
            return (np.arange(self.drive_count),)
        each = [np.concatenate(self.drives[signals]) for signals in order]
        _, numbers = np.unique(np.concatenate(each), return_inverse=True)
        return tuple(np.split(numbers, np.cumsum([len(part) for part in each])[:-1]))
