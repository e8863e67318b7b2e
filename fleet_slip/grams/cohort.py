"""Cohorts: the Gram rows of the drives that satisfy an SQL condition, and their sums over folds.

A cohort is Gram rows with a fold and a weight. What needs every drive reads them into memory; what
compares given models needs the exact sum of each fold alone, of any number of rows.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from fractions import Fraction
from functools import cache, cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, IntArray
from fleet_slip.base import number_of
from fleet_slip.catalogue.facts import RECEIVED, SCENARIO, TRAINING_DRIVES
from fleet_slip.catalogue.features import PLAIN, features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, NotComputedError, QuestionError, RefusedError
from fleet_slip.grams.expansion import about_mean, expansion_of
from fleet_slip.grams.folding import (
    EACH,
    FOLD_KEYS,
    PARTS,
    ROW_FOLDS,
    FoldCount,
    Folding,
    FoldKey,
    assign_folds,
    require_divided,
)
from fleet_slip.grams.gram_rows import Hashes
from fleet_slip.grams.reader import HASHES, CohortOrigin, GramReader, OpenedGrams, open_grams
from fleet_slip.regression.choice import TrainingFolds
from fleet_slip.regression.drives import (
    ClusterUnit,
    DriveMoments,
    missing_signals_error,
    serving_drives,
)
from fleet_slip.regression.folds import CohortFolds, Folds
from fleet_slip.regression.gram import Gram, GramTable
from fleet_slip.warehouse.condition import Condition, parse_cohort
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class Members:
    """The drives that Gram rows are of, by the rows' signals.

    Each row of an array has the hashes of a drive and of its car, 1 if it came without a log, and
    its fold; shape (rows, 4).
    """

    rows: dict[str, Hashes] = field(default_factory=dict)

    def __add__(self, other: "Members") -> "Members":
        both = dict(self.rows)
        for signals, rows in other.rows.items():
            both[signals] = np.concatenate([both[signals], rows]) if signals in both else rows
        return Members(both)

    def having(self, signals: Collection[str]) -> Hashes:
        """Return the rows that have all of some signals."""
        some = [rows for kind, rows in self.rows.items() if set(signals) <= set(kind.split(","))]
        return np.concatenate([np.empty((0, 4), dtype=np.uint64), *some])

    def drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives that have all of some signals, each once, sorted."""
        return np.unique(self.having(signals)[:, 0])

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars that have all of some signals."""
        return len(np.unique(self.having(signals)[:, 1]))

    def count_received_with(self, signals: Collection[str] = ()) -> int:
        """Return the number of drives without a log that have all of some signals."""
        rows = self.having(signals)
        return len(np.unique(rows[rows[:, 2] == 1, 0]))


def _member_rows(rows: pa.Table | pa.RecordBatch, folds: IntArray) -> Hashes:
    drives, cars = (rows[name].to_numpy() for name in ("drive_hash", "vehicle_hash"))
    came = pc.fill_null(pc.equal(rows["source"].cast(pa.string()), RECEIVED), False)
    received = came.to_numpy(zero_copy_only=False)
    return np.stack([one.astype(np.uint64) for one in (drives, cars, received, folds)], axis=1)


@dataclass(frozen=True)
class Served:
    """The drives of a cohort with all of some signals: a Gram row and metadata each, in order."""

    table: GramTable
    drives: pa.Table


@dataclass(frozen=True, kw_only=True)
class Cohort(CohortOrigin):
    """Gram rows in a `GramTable` for each set of signals, and metadata of each row in their order.

    A drive has several rows if a signal is in some of its rows only, or if its set has parts.
    """

    tables: tuple[GramTable, ...]
    drives: pa.Table

    @property
    def rows(self) -> int:
        """Number of rows of the logs behind the cohort."""
        return int(sum(table.n.sum() for table in self.tables))

    @cached_property
    def drive_numbers(self) -> IntArray:
        """The drive of each Gram row, numbered from 0."""
        indices = pc.dictionary_encode(self.drives["drive_id"].combine_chunks()).indices
        return np.asarray(indices.to_numpy(), dtype=np.int64)

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        return int(self.drive_numbers.max()) + 1

    @property
    def members(self) -> Members:
        """Which drives and cars the Gram rows are of."""
        rows = _member_rows(self.drives, np.zeros_like(self.drive_numbers))
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        names = (",".join(table.signals) for table in self.tables)
        return Members(dict(zip(names, np.split(rows, stops), strict=True)))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals and features that any of the drives has, in the order of the feature set."""
        return self.inputs_among(name for table in self.tables for name in table.signals)

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the cohort into folds, of whole drives unless by `row`.

        By a key of `FOLD_KEYS`: a fold for each value, or hashed into `count` if there are more
        (`EACH`: never); by `speed` in bands; by `part` or `row` as the feature set has them. Raises
        `QuestionError` if it has none.
        """
        require_divided(self.feature_set, by, count)
        values = self.drives[FOLD_KEYS[by]].to_pylist()
        return CohortFolds.of(self.tables, assign_folds(values, by, count), self.drive_numbers)

    def serving(self, inputs: Sequence[str]) -> Served:
        """Return the drives with the label and all inputs, a Gram row each. Raises `DataError`."""
        table, mask = serving_drives(self.tables, [*inputs, catalogue().label])
        rows = np.flatnonzero(mask)
        numbers = self.drive_numbers[rows]
        order = np.argsort(numbers, kind="stable")
        _, first = np.unique(numbers[order], return_index=True)
        if len(first) == len(rows):
            return Served(table, self.drives.take(rows))
        merged = GramTable(
            table.signals,
            *(
                np.add.reduceat(part[order], first)
                for part in (table.n, table.sums, table.products)
            ),
        )
        return Served(merged, self.drives.take(rows[order[first]]))

    def part(self, wanted: BoolArray) -> "Cohort":
        """Return the cohort with some of its Gram rows only; the mask lists them all."""
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        masks = np.split(wanted, stops)
        kept = [table.take(m) for table, m in zip(self.tables, masks, strict=True) if m.any()]
        return replace(self, tables=tuple(kept), drives=self.drives.filter(pa.array(wanted)))


def load_cohort(
    warehouse: Warehouse | GramReader,
    condition: str | Condition = TRAINING_DRIVES,
    feature_set: str = PLAIN,
) -> Cohort:
    """Read the Gram rows of the drives that satisfy a condition.

    Raises `QuestionError` for an invalid
    condition, `DataError` if no drive satisfies it or the set was not computed for all logs,
    `RefusedError` for drives of evaluation scenarios.
    """
    condition = parse_cohort(condition)
    with open_grams(warehouse, feature_set, condition) as opened:
        expansion = expansion_of(opened, feature_set)
        rows = opened.rows(condition)
        require_training(rows["source"].unique().to_pylist(), condition)
        parts = list(expansion.tables(rows))
        if not parts:  # no row, or none of changes
            raise empty_cohort_error(opened, condition)
        origin = opened.origin(condition)
    # Rows whose calibrated columns are not the same are apart now: their metadata follows them.
    order = np.concatenate([np.flatnonzero(here) for _, _, here in parts])
    return Cohort(
        **vars(origin),
        tables=tuple(table for _, table, _ in parts),
        drives=rows.drop_columns(["sums", "products"]).take(order),
    )


def require_training(sources: Iterable[str], condition: Condition) -> None:
    """Raise `RefusedError` if drives of a scenario are among those of a condition."""
    if SCENARIO in sources:
        raise RefusedError(
            f"the cohort {condition.text!r} has drives of evaluation scenarios, which no model "
            f"may be trained on. Add to the condition: AND {TRAINING_DRIVES}"
        )


def empty_cohort_error(opened: OpenedGrams, condition: Condition) -> DataError:
    """Return the error that tells why a condition leaves no drive."""
    if left_out := opened.count_left_out(condition):
        return NotComputedError(
            f"all {number_of(left_out, 'drive')} of the cohort {condition.text!r} are of cars that "
            "sent Gram rows of the logged signals and no log. Select with features = signals."
        )
    one = features().feature_set(features().name_of(opened.identity))
    if one.change_s:
        return DataError(
            f"no drive of the cohort {condition.text!r} has fixes of a satellite receiver that are "
            f"{one.change_text} apart: nothing tells the course. Choose another cohort, or map the "
            "course and ingest again: docs/course.md."
        )
    examples = opened.database.execute(
        "SELECT string_agg(DISTINCT source, ', ' ORDER BY source), "
        "string_agg(DISTINCT campaign, ', ' ORDER BY campaign) FROM grams "
        f"WHERE {TRAINING_DRIVES}"
    ).fetchone()
    sources, campaigns = examples or ("", "")
    return DataError(
        f"no drive satisfies the cohort condition {condition.text!r}. The warehouse has sources "
        f"{sources} and campaigns {campaigns}. See the columns with: "
        'fleet-slip sql "DESCRIBE drives"'
    )


# Labels of few cars and the course of all others as one cohort: a weighted sum.
#
# Rows with the label count about their drive's mean, since changes have no constant either: it
# follows from cars that go straight on (`fleet_slip.models.straight_on`). Only these drives are
# tested on; the course of others is always trained on, with a weight.


@dataclass(frozen=True, kw_only=True)
class TaughtCohort(Cohort):
    """The drives with the label, and the changes of others, whose rows have a `weight` beside 1."""

    others: Cohort
    weight: Fraction

    @property
    def members(self) -> Members:
        """Which drives and cars teach, with a label or without."""
        return super().members + self.others.members

    @property
    def inputs(self) -> tuple[str, ...]:
        """The columns that drives with the label and changes of the others both have."""
        others = set(self.others.inputs)
        return tuple(name for name in super().inputs if name in others)

    def count_others(self, signals: Collection[str]) -> tuple[int, int]:
        """Return how many drives, and changes, teach beside those with the label."""
        served = [one for one in self.others.tables if set(signals) <= set(one.signals)]
        drives = len(self.others.members.drives_with(signals))
        return drives, sum(int(one.n.sum()) for one in served)

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the drives with the label into folds; what the others teach is in none."""
        values = set(self.drives[FOLD_KEYS[by]].to_pylist())
        if by == "vehicle" and len(values) == 1:
            by = "drive"
        beside = tuple(table.total() for table in self.others.tables)
        return replace(super().folds(by, count), beside=beside, weight=self.weight)


def load_taught(
    warehouse: Warehouse, condition: str | Condition, feature_set: str, by: FoldKey
) -> TaughtCohort:
    """Read the Gram rows of the drives that satisfy a condition, of both kinds; the weight is 1.

    What folds are made of teaches by its label alone if it has one. Raises `DataError` if no drive
    has one, or all have, and as `load_cohort`.
    """
    base = features().feature_set(feature_set).of
    if base is None:
        raise DataError(
            f"the feature set {feature_set} is not of another, whose Gram rows have the label. Use "
            "one that has of in configs/features.toml, such as course."
        )
    return taught_by(
        load_cohort(warehouse, condition, base), load_cohort(warehouse, condition, feature_set), by
    )


def taught_by(every: Cohort, changes: Cohort, by: FoldKey) -> TaughtCohort:
    """Return what the drives of a cohort with the label teach, and the changes of the others."""
    label = catalogue().label
    labelled = every.part(
        np.repeat([label in one.signals for one in every.tables], [len(t) for t in every.tables])
    )
    if not labelled.tables:
        raise DataError(
            f"no drive of the cohort {every.condition.text!r} has the label. Learn from the course "
            "alone: fleet-slip select --label course"
        )
    key = FOLD_KEYS["vehicle" if by == "vehicle" and _cars(labelled) > 1 else "drive"]
    known = set(labelled.drives[key].to_pylist())
    alone = np.array([one not in known for one in changes.drives[key].to_pylist()])
    if not alone.any():
        raise DataError(
            f"all drives of the cohort {every.condition.text!r} have the label. Learn from it "
            "alone: fleet-slip select"
        )
    tables = tuple(about_mean(table) for table in labelled.tables)
    own = {**vars(labelled), "feature_set": changes.feature_set, "tables": tables}
    own = {name: own[name] for name in Cohort.__dataclass_fields__}
    return TaughtCohort(**own, others=changes.part(alone), weight=Fraction(1))


def _cars(cohort: Cohort) -> int:
    return len(cohort.drives["vehicle_id"].unique())


# The sums of a cohort over its folds, from Gram rows read batch by batch.


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

    Raises as `load_cohort`, and `DataError` for one fold.
    """
    condition = parse_cohort(condition)
    require_divided(feature_set, folding.by, folding.count)
    with open_grams(warehouse, feature_set, condition) as opened:
        folds = _find_folds(opened, folding, condition)
        grams, members = _add_up(opened, condition, *folds)
        origin = opened.origin(condition)
    sums = _used_folds(folds[0], grams, members)
    return SummedCohort(
        **vars(origin),
        folding=folding,
        sums=sums,
        rows=sum(gram.n for of_folds in grams.values() for gram in of_folds),
        drive_count=len(members.drives_with(())),
        members=members,
        source=warehouse,
    )


FoldOf = Callable[[pa.RecordBatch], IntArray]
"""Returns the fold of each Gram row, by its metadata."""


def _add_up(
    opened: OpenedGrams, condition: Condition, names: Sequence[object], fold_of: FoldOf
) -> tuple[dict[str, list[Gram]], Members]:
    """Return the exact sums of Gram rows, by signals and fold, and which drives they are of."""
    expansion = expansion_of(opened, features().name_of(opened.identity))
    grams: dict[str, list[Gram]] = {}
    rows: dict[str, list[Hashes]] = {}
    for batch in opened.batches(condition, *HASHES):
        require_training(batch["source"].unique().to_pylist(), condition)
        folds = fold_of(batch)
        some = _member_rows(batch, folds)
        for signals, table, here in expansion.tables(batch):
            totals, before = table.totals(folds[here], len(names)), grams.get(signals)
            grams[signals] = list(map(Gram.__add__, before, totals)) if before else totals
            rows.setdefault(signals, []).append(some[here])
    if not grams:
        raise empty_cohort_error(opened, condition)
    return grams, Members({signals: np.concatenate(some) for signals, some in rows.items()})


def _find_folds(
    opened: OpenedGrams, folding: Folding, condition: Condition
) -> tuple[Sequence[str], FoldOf]:
    """Return the folds that there may be, and which a Gram row is in. Raises like `sum_cohort`."""
    key = FOLD_KEYS[folding.by]
    dealt = folding.by in ("drive", "vehicle") and folding.count != EACH
    found = opened.values_of(key, condition, int(folding.count) + 1 if dealt else None)
    if dealt and len(found) > (count := int(folding.count)):
        hashed = key.removesuffix("_id") + "_hash"
        names = [str(fold + 1) for fold in range(count)]
        return names, lambda rows: (rows[hashed].to_numpy() % count).astype(np.int64)
    if not len(found):
        raise empty_cohort_error(opened, condition)
    assignment = assign_folds(found.to_pylist(), folding.by, folding.count)
    return assignment.names, lambda rows: assignment.fold[_places(rows[key], found)]


def _places(values: pa.Array, known: pa.Array) -> IntArray:
    places: IntArray = pc.index_in(values.cast(known.type), value_set=known).to_numpy()
    return places


def _used_folds(
    names: Sequence[str], grams: dict[str, list[Gram]], members: Members
) -> CohortFolds:
    """Return the folds that have drives. Raises `DataError` if only one has."""
    order = sorted(grams)
    used = [fold for fold in range(len(names)) if any(grams[kind][fold].n for kind in order)]
    if len(used) < 2:
        raise DataError(
            "cross-validation needs at least two folds, and the cohort has one: "
            f"{names[used[0]]}. Widen the cohort, or fold by another key."
        )

    @cache
    def count_drives(kinds: tuple[int, ...]) -> int:
        return len(np.unique(np.concatenate([members.rows[order[i]][:, 0] for i in kinds])))

    return CohortFolds(
        tuple(names[fold] for fold in used),
        tuple(tuple(grams[kind][fold] for fold in used) for kind in order),
        lambda tables: count_drives(tuple(tables)),
    )


@dataclass(frozen=True)
class DailySums:
    """The Gram of each day, and the number of drives in it.

    `left_out` drives of the condition have no such Gram rows: their cars sent no log.
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
    condition = parse_cohort(condition)
    with open_grams(source, feature_set, condition) as opened:
        found = opened.values_of("day", condition).sort()
        days: list[date] = found.to_pylist()
        sums, members = _add_up(opened, condition, days, lambda rows: _places(rows["day"], found))
        left_out = opened.count_left_out(condition)
    serving = [one for kind, one in sums.items() if set(signals) <= set(kind.split(","))]
    if not serving:
        raise missing_signals_error(signals)
    grams = [
        sum((one[day].restrict(signals) for one in serving), Gram.zero(signals))
        for day in range(len(days))
    ]
    rows = members.having(signals)
    _, first = np.unique(rows[:, 0], return_index=True)  # a drive is of one day
    drives = np.bincount(rows[first, 3].astype(np.int64), minlength=len(days)).tolist()
    used = [day for day, gram in enumerate(grams) if gram.n]
    return DailySums(
        tuple(days[day] for day in used),
        tuple(grams[day] for day in used),
        tuple(drives[day] for day in used),
        left_out,
    )


# A cohort made ready for one set of inputs: folds, and moments of each drive.


@dataclass(frozen=True)
class DriveFolds:
    """The drives that have all of some inputs, the fold of each, and what is computed from."""

    served: Served
    fold: IntArray
    training: TrainingFolds

    @property
    def moments(self) -> DriveMoments:
        """Moments of each drive, for cluster-robust errors and resampling."""
        if self.training.drives is None:
            return clustered_moments(self.served)
        return self.training.drives


def clustered_moments(
    served: Served,
    cluster: ClusterUnit | None = None,
    cars: Sequence[str] = (),
    *,
    intercept: bool = True,
) -> DriveMoments:
    """Return the moments of each drive, and which of them are one piece of evidence.

    By default cars where there are several, else drives; numbered by place among `cars`, so that
    two cohorts can share them. Without an intercept moments are about zero.
    """
    table = served.table if intercept else served.table.about_origin()
    owners = served.drives["vehicle_id"].to_pylist()
    cars = cars or owners
    if (cluster or ("vehicle" if len(set(cars)) > 1 else "drive")) == "drive":
        trips = served.drives["trip"].to_pylist()
        if len(set(trips)) == len(trips):
            return DriveMoments.of(table)
        _, of_trip = np.unique(trips, return_inverse=True)
        return DriveMoments.of(table, of_trip.astype(np.int64), "drive")
    number = {car: i for i, car in enumerate(sorted(set(cars)))}
    of_drive = np.array([number[car] for car in owners], dtype=np.int64)
    return DriveMoments.of(table, of_drive, "vehicle")


def drive_folds(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    *,
    naive: bool = False,
    cluster: ClusterUnit | None = None,
    intercept: bool = True,
) -> DriveFolds:
    """Divide the drives with all the inputs into folds; `naive` takes rows for independent.

    Raises `DataError` if no drive has them all, and `QuestionError` for folds of rows.
    """
    if folding.by in (ROW_FOLDS, PARTS):
        raise QuestionError(
            f"with folds by {folding.by} there are no drives to hold out. Fold by drive for this."
        )
    served = cohort.serving(inputs)
    assignment = assign_folds(
        served.drives[FOLD_KEYS[folding.by]].to_pylist(), folding.by, folding.count
    )
    folds = CohortFolds.of([served.table], assignment).serving(inputs, catalogue().label)
    moments = None if naive else clustered_moments(served, cluster, intercept=intercept)
    training = TrainingFolds(folds, moments, input_scales(), intercept)
    return DriveFolds(served, assignment.fold, training)


def row_training(
    cohort: Cohort, inputs: Sequence[str], folding: Folding, *, intercept: bool = True
) -> TrainingFolds:
    """Return folds of rows; rows then count as independent. Raises `DataError`."""
    folds: Folds = cohort.folds(folding.by, folding.count).serving(inputs, catalogue().label)
    return TrainingFolds(folds, None, input_scales(), intercept)
