"""The sums of a cohort over its folds, from Gram rows read batch by batch.

Comparing given models needs the Gram of each fold alone: any number of rows fits in memory.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import date

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import IntArray
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.catalogue.features import PLAIN
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cells import Members, received_among
from fleet_slip.grams.cohort import empty_cohort, require_training
from fleet_slip.grams.expansion import Expansion, expansion_of
from fleet_slip.grams.folding import (
    EACH,
    FOLD_KEYS,
    FoldCount,
    Folding,
    FoldKey,
    assign_folds,
    require_divided,
)
from fleet_slip.grams.gram_rows import Hashes, hash_numbers
from fleet_slip.grams.reader import CohortOrigin, GramReader, OpenedGrams, open_grams
from fleet_slip.regression.drives import missing_signals_error
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.gram import Gram, GramTable
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

    Raises as `fleet_slip.grams.cohort.load_cohort`, and `DataError` for one fold.
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


# The sums of a cohort over each day, from Gram rows read batch by batch.


@dataclass(frozen=True)
class DailySums:
    """The Gram of each day, and the number of drives in it.

    Attributes:
        left_out: drives of the condition that have no such Gram rows: their cars sent no log.
    """

    days: tuple[date, ...]
    grams: tuple[Gram, ...]
    drives: tuple[int, ...]
    left_out: int


def sum_days(
    source: Warehouse | GramReader,
    inputs: Sequence[str],
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> DailySums:
    """Add up a cohort's Gram rows with label and inputs, day by day. Raises like `load_cohort`."""
    signals = (*inputs, catalogue().label)
    days: dict[date, _Day] = defaultdict(_Day)
    found = False
    condition = parse_cohort(condition)
    with open_grams(source, feature_set, condition) as opened:
        expansion = expansion_of(opened, feature_set)
        for batch in opened.batches(condition):
            found = True
            require_training(batch["source"].unique().to_pylist(), condition)
            for names, table, chosen in expansion.tables(batch):
                if set(signals) <= set(names.split(",")):
                    rows = batch.filter(pa.array(chosen))
                    _add_rows(days, names, table.restrict(signals), rows)
        left_out = opened.count_left_out(condition)
        if not found:
            raise empty_cohort(source, condition, feature_set)
    if not days:
        raise missing_signals_error(signals)
    ordered = [days[day] for day in sorted(days)]
    return DailySums(
        tuple(sorted(days)),
        tuple(day.total() for day in ordered),
        tuple(day.members.count_drives(day.grams) for day in ordered),
        left_out,
    )


@dataclass
class _Day:
    """What a day comes to: its Grams and drives by the signals of the Gram rows."""

    grams: dict[str, Gram] = field(default_factory=dict)
    members: Members = field(default_factory=Members)

    def add(self, names: str, gram: Gram, drives: Hashes, vehicles: Hashes) -> None:
        """Add Gram rows of the same signals."""
        self.grams[names] = self.grams[names] + gram if names in self.grams else gram
        self.members.add(names, drives, vehicles)

    def total(self) -> Gram:
        """Return the sum of its Grams."""
        first, *others = (self.grams[names] for names in sorted(self.grams))
        return sum(others, first)


def _add_rows(days: dict[date, _Day], names: str, table: GramTable, rows: pa.RecordBatch) -> None:
    here = rows["day"].dictionary_encode()
    number, values = here.indices.to_numpy(), here.dictionary.to_pylist()
    ids = hash_numbers(rows["drive_id"])
    for i, total in enumerate(table.totals(number, len(values))):
        mine = rows["vehicle_id"].filter(pa.array(number == i)).unique()
        days[values[i]].add(names, total, ids[number == i], hash_numbers(mine))
