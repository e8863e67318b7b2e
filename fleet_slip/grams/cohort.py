"""Cohorts: the Gram rows of the drives that satisfy an SQL condition."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import BoolArray, IntArray, number_of
from fleet_slip.catalogue.facts import SCENARIO, TRAINING_DRIVES
from fleet_slip.catalogue.features import PLAIN, features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, NotComputedError, QuestionError, RefusedError
from fleet_slip.grams.cells import Hashed, Members, received_among
from fleet_slip.grams.expansion import about_mean, expansion_of
from fleet_slip.grams.folding import (
    FOLD_KEYS,
    PARTS,
    ROW_FOLDS,
    FoldCount,
    Folding,
    FoldKey,
    assign_folds,
    require_divided,
)
from fleet_slip.grams.gram_rows import hash_numbers
from fleet_slip.grams.reader import CohortOrigin, GramReader, OpenedGrams, open_grams
from fleet_slip.regression.choice import TrainingFolds
from fleet_slip.regression.drives import ClusterUnit, DriveMoments, serving_drives
from fleet_slip.regression.folds import CohortFolds, Folds
from fleet_slip.regression.gram import GramTable
from fleet_slip.warehouse.condition import Condition, asking, parse_cohort
from fleet_slip.warehouse.tables import Warehouse


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
        hashes, cars = (hash_numbers(self.drives[name]) for name in ("drive_id", "vehicle_id"))
        stops = np.cumsum([len(table) for table in self.tables])[:-1]
        names = [",".join(table.signals) for table in self.tables]
        drives, vehicles = np.split(hashes, stops), np.split(cars, stops)
        came = np.split(received_among(self.drives), stops)
        received = [some[mask] for some, mask in zip(drives, came, strict=True)]
        return Members(
            *(
                {name: Hashed(some) for name, some in zip(names, parts, strict=True)}
                for parts in (drives, vehicles, received)
            )
        )

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
        statement = opened.statement("cohort.sql", condition)
        with asking(opened.database, condition):
            rows = opened.database.sql(statement).to_arrow_table()
        origin = opened.origin(condition)
        if not rows.num_rows:
            raise empty_cohort_error(opened, condition)
    require_training(rows["source"].unique().to_pylist(), condition)
    parts = list(expansion.tables(rows))
    if not parts:  # of changes, and there are none
        raise empty_cohort(warehouse, condition, feature_set)
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


def empty_cohort(
    source: Warehouse | GramReader, condition: Condition, feature_set: str
) -> DataError:
    """Return the error that tells why a condition leaves no drive, from all Gram rows."""
    with open_grams(source, feature_set, condition) as opened:  # all of them: it says what there is
        return empty_cohort_error(opened, condition)


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
